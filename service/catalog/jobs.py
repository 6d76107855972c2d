"""Jobs: what a client follows. Every change of state is one guarded UPDATE, so a terminal state is never left.

accepted -> running -> successful | failed | dismissed, and accepted -> failed | dismissed

A job is at one step at a time, and the catalog knows at which: the step waits (`due`), or a worker has begun it
(`begun`). The queue is told what to do next (service/dispatch.py) and is never asked how far a job is.

A step that ends without a result is started again, and not for ever. A crash may be the file's fault, and then every
attempt ends so: three are made. What comes from outside (a killed process, a lost machine, a database that is away)
costs no attempt, and is borne twenty times, with a growing wait.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, cast

from sqlalchemy import ColumnElement, CursorResult, func, select, update
from sqlalchemy.orm import Session

from service.catalog import tallies
from service.catalog.findings import history
from service.catalog.following.publication import tell
from service.catalog.idempotency import ANY_TIMES, Once
from service.catalog.records import EventType, JobRecord, JobStatus, Page, Position, Problem, rfc3339
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.sql.tables import new_id, now
from service.catalog.steps import STEPS, JobKind, Step, first_step, step_after, step_of
from service.catalog.steps import Queue as QueueName
from service.errors import Conflict, NotFound

MAX_ATTEMPTS = 3  #: of one step
MAX_INTERRUPTIONS = 20  #: of one step
_BEGINS = timedelta(seconds=2)  #: that a worker which is free may take to begin
_LONGEST_DELAY_S = 30.0  #: before a step that was interrupted again and again
WORKER_DIED = "worker_died"  #: code of the problem of a job that is given up

_OPEN = tables.Job.status.in_(("accepted", "running"))


@dataclass(frozen=True, kw_only=True, slots=True)
class OpenSteps:
    """Steps of one name that wait, or that run."""

    kind: JobKind
    step: str  #: empty: the first one
    waits: bool
    count: int
    since: datetime  #: when the oldest came due, or began


@dataclass(frozen=True, kw_only=True, slots=True)
class OpenJob:
    """A job that has not ended, as it is dispatched."""

    job_id: str
    kind: JobKind
    step: str  #: name of the step that is due or runs
    status: JobStatus
    owner: str  #: who shares the workers with others: a device, else the map
    created: datetime
    due: datetime  #: when the step may begin
    begun: datetime | None  #: when a worker began the step; None while it waits

    @property
    def queue_step(self) -> Step:
        """The step itself."""
        return step_of(self.kind, self.step)


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """One run of a step: what a worker holds from `begin` to `advance`."""

    job_id: str
    step: str
    begun: datetime  #: tells it from another run of the same step


class Jobs:
    """The jobs of the catalog. What the workers call may be called twice, and after the job has ended or gone."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def get(self, job_id: str) -> JobRecord:
        """Return one job. Raises NotFound."""
        with self._database.read() as session:
            return JobRecord.of_row(_row(session, job_id))

    def page(
        self,
        *,
        status: JobStatus | None = None,
        map_id: str | None = None,
        only_maps: Collection[str] | None = None,
        after: Position | None = None,
        limit: int = 100,
    ) -> Page[JobRecord]:
        """Return jobs, newest first; of `only_maps` where these are given."""
        query = select(tables.Job)
        if status is not None:
            query = query.where(tables.Job.status == status)
        if map_id is not None:
            query = query.where(tables.Job.map_id == map_id)
        if only_maps is not None:
            query = query.where(tables.Job.map_id.in_(only_maps))
        created, key = tables.Job.created, tables.Job.job_id
        return self._database.page(query, created, key, JobRecord.of_row, after=after, limit=limit)

    def unfinished(self, map_id: str | None = None) -> tuple[JobRecord, ...]:
        """Return the jobs that wait or run, of one map and its surveys or of all, in the order they were asked for."""
        query = select(tables.Job).where(_OPEN).order_by(tables.Job.created, tables.Job.job_id)
        if map_id is not None:
            query = query.where(tables.Job.map_id == map_id)
        with self._database.read() as session:
            return tuple(JobRecord.of_row(row) for row in session.scalars(query))

    def counts(self) -> dict[str, int]:
        """Count the jobs in each state; states without a job are left out."""
        query = select(tables.Job.status, func.count()).group_by(tables.Job.status)
        with self._database.read() as session:
            return dict(session.execute(query).all())

    def open_steps(self) -> tuple[OpenSteps, ...]:
        """Count the steps that wait and those that run, by kind of job and step, with the oldest of each."""
        table = tables.Job
        waits, since = table.begun.is_(None), func.min(func.coalesce(table.begun, table.due, table.created))
        query = select(table.kind, table.step, waits, func.count(), since).where(_OPEN)
        with self._database.read() as session:
            rows = session.execute(query.group_by(table.kind, table.step, waits)).all()
        return tuple(
            OpenSteps(kind=cast("JobKind", kind), step=step, waits=bool(waits), count=count, since=since)
            for kind, step, waits, count, since in rows
        )

    def open_jobs(self) -> tuple[OpenJob, ...]:
        """Return all that has not ended, in the order they were asked for."""
        job = tables.Job
        columns = (job.job_id, job.kind, job.step, job.status, job.owner, job.map_id)
        known = job.kind.in_(list(STEPS))  # a newer release, at work beside this one, may have others
        query = select(*columns, job.created, job.due, job.begun).where(_OPEN, known)
        query = query.order_by(job.created, job.job_id)
        with self._database.read() as session:
            return tuple(
                OpenJob(
                    job_id=row.job_id,
                    kind=row.kind,
                    step=step_of(row.kind, row.step).name,
                    status=row.status,
                    owner=row.owner or row.map_id,
                    created=row.created,
                    due=row.due or row.created,
                    begun=row.begun,
                )
                for row in session.execute(query)
            )

    def waiting(self, owner: str | None = None) -> int:
        """Count the jobs that no worker has begun, of one owner or of all."""
        query = select(func.count()).where(tables.Job.status == "accepted")
        if owner is not None:
            query = query.where(tables.Job.owner == owner)
        with self._database.read() as session:
            return session.scalar(query) or 0

    def surveys_wait(self, queue: QueueName) -> bool:
        """Tell whether a survey waits for a worker of a queue."""
        names = {step.name for step in STEPS["survey"] if step.queue == queue}
        job = tables.Job
        query = select(job.job_id).where(
            _OPEN, job.kind == "survey", job.begun.is_(None), job.step.in_(names), job.due <= now() - _BEGINS
        )
        with self._database.read() as session:
            return session.scalar(query.limit(1)) is not None

    def begin(self, job_id: str, step: str) -> Run | None:
        """Mark a step as running; None when it is not due: the job has ended, gone on, or another worker has it."""
        begun = now()
        due = (tables.Job.step == step, tables.Job.begun.is_(None))
        if not self._advance(job_id, *due, **_started(), begun=begun):
            return None
        return Run(job_id=job_id, step=step, begun=begun)

    def report(self, run: Run, *, message: str, progress: float) -> bool:
        """Say the stage and the share (0..1) of the whole job; False when the work should stop.

        The share never falls: a step that runs again reports from where the job already was.
        """
        percent = round(100 * min(max(progress, 0.0), 1.0))
        largest = func.greatest if self._database.engine.dialect.name == "postgresql" else func.max
        values = {"message": message, "progress": largest(tables.Job.progress, percent), "updated": now()}
        return self._advance(run.job_id, *_of_run(run), **values)

    def advance(self, run: Run) -> bool:
        """Go on to the step behind one that ended well; False when the job had ended, or another run has the step."""
        with self._database.write() as session:
            ran = _ran(session, run.job_id)
            following = None if ran is None else step_after(ran.kind, run.step)
            if following is None:
                return False
            fresh = {"attempts": 0, "interruptions": 0, "updated": now()}
            values = {"step": following.name, **fresh, **_due()}
            return _changed(session, run.job_id, values, *_of_run(run), ran=ran, outcome="successful")

    def succeed(self, job_id: str, *, run: Run | None = None) -> bool:
        """Mark the job as done and its map's version, survey or model as ready; False when it had ended or gone.

        With `run` also where another run has the step by now.
        """
        where = () if run is None else _of_run(run)
        return self._end(job_id, "successful", *where, message="done", progress=100)

    def fail(
        self, job_id: str, problem: Problem, *, step: str | None = None, begun: datetime | None = None
    ) -> bool:
        """Mark the job and its map's version, survey or model as failed; False when it had ended or gone.

        `step` names the step that failed, and `begun` its run; where the job is at another by now, nothing is changed.
        """
        where = _at(step, begun)
        return self._end(job_id, "failed", *where, message=problem.detail, problem=problem.model_dump())

    def dismiss(self, job_id: str) -> JobRecord:
        """Stop the job for good; once more changes nothing. Raises NotFound, and Conflict when it ended by itself."""
        problem = Problem(code="dismissed", detail="the job was dismissed")
        dismissed = self._end(job_id, "dismissed", message=problem.detail, problem=problem.model_dump())
        job = self.get(job_id)
        if not dismissed and job.status != "dismissed":
            raise Conflict(f"job {job_id!r} is already {job.status}; delete its map or survey instead")
        return job

    def run_again(self, job_id: str, *, once: Once = ANY_TIMES) -> JobRecord:
        """Have a failed job go on with the step that it failed in; one that has not ended is left as it is.

        Raises what `once` does, NotFound, and Conflict for a job that ended otherwise, whose map, survey or model is gone, or beside which
        another version of the map is being built.
        """
        with self._database.write() as session:
            once.claim(session)
            job = _row(session, job_id)
            session.get(tables.Map, job.map_id, with_for_update=True)
            if job.status in ("accepted", "running"):
                record = JobRecord.of_row(job)
                once.keep(session, record)
                return record
            subject = _subject(session, job)
            if job.status != "failed" or subject is None:
                raise Conflict(f"job {job_id!r} is {job.status}; only one that failed can be run again")
            if job.kind == "map":
                _check_no_other_builds(session, job)
            instant = now()
            job.status, job.problem, job.finished = "running" if job.started else "accepted", None, None
            job.message, job.attempts, job.interruptions = "waiting, to be run again", 0, 0
            job.due, job.begun, job.updated = instant, None, instant
            subject.status, subject.updated = _UNDER_WAY[cast("JobKind", job.kind)], instant
            session.flush()
            record = JobRecord.of_row(job)
            once.keep(session, record)
            return record

    def lose_attempt(self, job_id: str, step: str, reason: str, *, begun: datetime | None = None) -> bool:
        """Count an attempt that ended without a result, by its own fault; `reason` is the first half of a sentence.

        True when the step waits again. False when this was the last attempt, and the job failed with `WORKER_DIED`; and
        when the job had ended, gone, or gone on.
        """
        count = tables.Job.attempts
        with self._database.write() as session:
            ran = _ran(session, job_id)
            attempts = _counted(session, job_id, step, count, *_at(step, begun))
            if attempts is None or ran is None:
                return False
            tallies.tally_attempt(session, kind=ran.kind, step=step)
            if attempts < MAX_ATTEMPTS:
                message = f"started again ({attempts + 1} of {MAX_ATTEMPTS}): {reason}"
                return _changed(session, job_id, {**_started(message), **_due()}, ran=ran, outcome="lost")
        self._give_up(job_id, step, f"{reason}; given up after {attempts} attempts")
        return False

    def interrupt(self, job_id: str, step: str, reason: str, *, begun: datetime | None = None) -> bool:
        """Put back a step that ended through no fault of its own, as `lose_attempt` does, at no attempt's cost.

        With `begun` only that very run: for who looked at the job before it looked at the queue. A step that nobody has
        begun is left as it is.
        """
        same = (*_at(step, begun), tables.Job.begun.is_not(None))
        with self._database.write() as session:
            ran = _ran(session, job_id)
            times = _counted(session, job_id, step, tables.Job.interruptions, *same)
            if times is None or ran is None:
                return False
            tallies.tally_interruption(session, kind=ran.kind, step=step)
            if times < MAX_INTERRUPTIONS:
                delay = min(2.0 ** (times - 3), _LONGEST_DELAY_S) if times > 3 else 0.0
                message = f"interrupted, goes on with the next worker that is free: {reason}"
                values = {**_started(message), **_due(delay)}
                return _changed(session, job_id, values, ran=ran, outcome="interrupted")
        self._give_up(job_id, step, f"{reason}; given up after {times} interruptions")
        return False

    def put_back(self, job_id: str, step: str, message: str, *, begun: datetime | None = None) -> bool:
        """Have a step wait again that gave way; False when nobody has begun it, or the job had ended, gone, or gone on."""
        where = (*_at(step, begun), tables.Job.begun.is_not(None))
        with self._database.write() as session:
            ran, values = _ran(session, job_id), {**_started(message), **_due()}
            return _changed(session, job_id, values, *where, ran=ran, outcome="put_back")

    def _give_up(self, job_id: str, step: str, detail: str) -> None:
        problem = Problem(code=WORKER_DIED, detail=f"{detail}, look at the worker's log and memory")
        self.fail(job_id, problem, step=step)

    def _advance(self, job_id: str, *where: ColumnElement[bool], **values: Any) -> bool:
        with self._database.write() as session:
            return _changed(session, job_id, values, *where)

    def _end(self, job_id: str, status: JobStatus, *where: ColumnElement[bool], **values: Any) -> bool:
        instant = now()
        with self._database.write() as session:
            job = session.get(tables.Job, job_id)
            if job is None:
                return False
            session.get(
                tables.Map, job.map_id, with_for_update=True
            )  # map, then survey, then job: in one order
            ended = {"status": status, "finished": instant, "updated": instant, "begun": None, "due": None}
            problem = values.get("problem")
            outcome = status if problem is None else problem["code"]
            ran = _ran(session, job_id)
            if not _changed(session, job_id, {**values, **ended}, *where, ran=ran, outcome=outcome):
                return False
            tallies.tally_job(session, kind=job.kind, outcome=outcome)
            _tell_end(session, job, status, problem)
            subject = _subject(session, job)
            if subject is not None:
                subject.status = "ready" if status == "successful" else "failed"
                subject.updated = instant
                _tell_subject(session, subject)
                if subject.status == "ready":
                    history.note(session, subject)
            return True


def _tell_end(
    session: Session, job: tables.Job, status: JobStatus, problem: Mapping[str, Any] | None
) -> None:
    tell(
        session,
        "job.ended",
        job.job_id,
        map_id=job.map_id,
        job_id=job.job_id,
        kind=job.kind,
        status=status,
        problem=None if problem is None else problem["code"],
        survey_id=job.survey_id,
        model=job.model,
    )


def _tell_subject(session: Session, subject: tables.MapVersion | tables.Survey | tables.Model) -> None:
    """Tell that a version, a survey or a model is ready, or failed."""
    ready = subject.status == "ready"
    about: dict[str, Any] = {"map_id": subject.map_id, "job_id": subject.job_id}
    if isinstance(subject, tables.Survey):
        event: EventType = "survey.ready" if ready else "survey.failed"
        about |= {"survey_id": subject.survey_id, "device_id": subject.device_id}
        about |= {"captured_at": rfc3339(subject.captured_at), "counts": subject.counts}
        about |= {"objects": subject.objects}
        tell(session, event, subject.survey_id, **about)
    elif isinstance(subject, tables.Model):
        event = "model.ready" if ready else "model.failed"
        model = f"{subject.name}/{subject.version}"
        tell(session, event, model, model=model, **about)
    else:
        event = "version.ready" if ready else "version.failed"
        version = f"{subject.map_id}/{subject.version}"
        tell(session, event, version, version=subject.version, **about)


def new_job(
    kind: JobKind,
    map_id: str,
    survey_id: str | None = None,
    *,
    model: str | None = None,
    owner: str | None = None,
) -> tables.Job:
    """Return a job that waits; the caller records it in the transaction of its map, survey or model.

    `owner` is who shares the workers with others, a device; left out, it is the map.
    """
    instant = now()
    return tables.Job(
        job_id=new_id("job"),
        kind=kind,
        map_id=map_id,
        survey_id=survey_id,
        model=model,
        status="accepted",
        message="waiting",
        progress=0,
        step=first_step(kind).name,
        due=instant,
        owner=owner,
        created=instant,
        updated=instant,
    )


def _started(message: str | None = None) -> dict[str, object]:
    """Return the columns of a job that runs, from this instant on or from an earlier one."""
    instant = now()
    columns = {"status": "running", "started": func.coalesce(tables.Job.started, instant), "updated": instant}
    return columns if message is None else {**columns, "message": message}


def _due(delay_s: float = 0.0) -> dict[str, object]:
    """Return the columns of a step that waits, from now on or from later on."""
    return {"due": now() + timedelta(seconds=delay_s), "begun": None}


def _at(step: str | None, begun: datetime | None) -> tuple[ColumnElement[bool], ...]:
    """Return what holds while the job is at a step, and in one run of it; of what is None nothing is asked."""
    at = () if step is None else (tables.Job.step == step,)
    return at if begun is None else (*at, tables.Job.begun == begun)


def _of_run(run: Run) -> tuple[ColumnElement[bool], ...]:
    """Return what holds as long as no other run has the step."""
    return tables.Job.step == run.step, tables.Job.begun == run.begun


def _counted(session: Session, job_id: str, step: str, count: Any, *where: ColumnElement[bool]) -> int | None:
    """Add one to a count of the step that a job is at, and return it; None where the job is not at it any more."""
    at_it = (tables.Job.job_id == job_id, tables.Job.step == step, _OPEN, *where)
    statement = update(tables.Job).where(*at_it).values({count.key: count + 1}).returning(count)
    return cast("int | None", session.scalar(statement))


#: What a version, a survey or a model is while its job has not ended.
_UNDER_WAY: dict[JobKind, str] = {"map": "building", "survey": "running", "model": "training"}


def _check_no_other_builds(session: Session, job: tables.Job) -> None:
    """Raise Conflict where another version of the job's map is being built."""
    version = tables.MapVersion
    others = select(version.job_id).where(version.map_id == job.map_id, version.status == "building")
    if (other := session.scalar(others)) is not None:
        raise Conflict(f"another version of map {job.map_id!r} is being built (job {other}); wait for it")


def _subject(session: Session, job: tables.Job) -> tables.MapVersion | tables.Survey | tables.Model | None:
    """Return what the job is there for; None where it was deleted since."""
    if job.survey_id is not None:
        return session.get(tables.Survey, job.survey_id)
    if job.kind == "model":
        return session.get(tables.Model, job.job_id)
    return session.get(tables.MapVersion, job.job_id)


def _row(session: Session, job_id: str) -> tables.Job:
    row = session.get(tables.Job, job_id)
    if row is None:
        raise NotFound(f"no job {job_id!r}; GET /jobs lists those there are")
    return row


@dataclass(frozen=True, kw_only=True, slots=True)
class _Ran:
    """The step that a job is at, and its times."""

    kind: JobKind
    step: str
    due: datetime | None
    begun: datetime | None


def _ran(session: Session, job_id: str) -> _Ran | None:
    """Return what the job is at, before that is changed."""
    job = tables.Job
    row = session.execute(select(job.kind, job.step, job.due, job.begun).where(job.job_id == job_id)).first()
    if row is None:
        return None
    return _Ran(kind=cast("JobKind", row.kind), step=row.step, due=row.due, begun=row.begun)


def _changed(
    session: Session,
    job_id: str,
    values: dict[str, Any],
    *where: ColumnElement[bool],
    ran: _Ran | None = None,
    outcome: str = "",
) -> bool:
    """Change an open job where that holds, and tell whether it did; a step that `ran` and ends so is tallied."""
    statement = update(tables.Job).where(tables.Job.job_id == job_id, _OPEN, *where).values(values)
    if cast("CursorResult[Any]", session.execute(statement)).rowcount != 1:
        return False
    if ran is not None and ran.begun is not None:
        waited, took = ran.begun - (ran.due or ran.begun), now() - ran.begun
        times = {"waited_s": waited.total_seconds(), "ran_s": took.total_seconds()}
        tallies.tally_step(session, kind=ran.kind, step=ran.step, outcome=outcome, **times)
    return True
