"""Jobs: what a client follows. Every change of state is one guarded UPDATE, so a terminal state is never left.

accepted -> running -> successful | failed | dismissed, and accepted -> failed | dismissed

A step that ends without a result is started again, and not for ever: a crash may be the file's fault, and then every
attempt ends so; or the machine's, and then the next one does not.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import Any, cast

from sqlalchemy import CursorResult, func, select, update
from sqlalchemy.orm import Session

from service.catalog import history, tables, tallies
from service.catalog.database import Database
from service.catalog.records import JobRecord, JobStatus, Page, Position, Problem
from service.catalog.steps import JobKind
from service.catalog.tables import new_id, now
from service.errors import Conflict, NotFound

MAX_ATTEMPTS = 3  #: of a whole job, whichever of its steps they are lost in
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

    def start(self, job_id: str) -> bool:
        """Mark the job as running; False when it has ended or gone, and the step has nothing to do."""
        return self._advance(job_id, **_started())

    def report(self, job_id: str, *, message: str, progress: float) -> bool:
        """Say the stage and the share (0..1) of the whole job; False when the work should stop.

        The share never falls: a step that runs again reports from where the job already was.
        """
        percent = round(100 * min(max(progress, 0.0), 1.0))
        largest = func.greatest if self._database.engine.dialect.name == "postgresql" else func.max
        return self._advance(
            job_id, message=message, progress=largest(tables.Job.progress, percent), updated=now()
        )

    def succeed(self, job_id: str) -> bool:
        """Mark the job as done and its map's version, survey or model as ready; False when it had ended or gone."""
        return self._end(job_id, "successful", message="done", progress=100)

    def fail(self, job_id: str, problem: Problem) -> bool:
        """Mark the job and its map's version, survey or model as failed; False when it had ended or gone."""
        return self._end(job_id, "failed", message=problem.detail, problem=problem.model_dump())

    def dismiss(self, job_id: str) -> JobRecord:
        """Stop the job for good; once more changes nothing. Raises NotFound, and Conflict when it ended by itself."""
        problem = Problem(code="dismissed", detail="the job was dismissed")
        dismissed = self._end(job_id, "dismissed", message=problem.detail, problem=problem.model_dump())
        job = self.get(job_id)
        if not dismissed and job.status != "dismissed":
            raise Conflict(f"job {job_id!r} is already {job.status}; delete its map or survey instead")
        return job

    def lose_attempt(self, job_id: str, reason: str) -> bool:
        """Count an attempt that ended without a result; `reason` is the first half of a sentence.

        True when the step shall be started again. False when this was the last attempt, and the job failed with
        `WORKER_DIED`; and when the job had ended or gone before.
        """
        lost = tables.Job.attempts + 1
        with self._database.write() as session:
            statement = update(tables.Job).where(tables.Job.job_id == job_id, _OPEN)
            attempts = session.scalar(statement.values(attempts=lost).returning(tables.Job.attempts))
            if attempts is None:
                return False
            if attempts < MAX_ATTEMPTS:
                message = f"started again ({attempts + 1} of {MAX_ATTEMPTS}): {reason}"
                return _changed(session, job_id, _started(message))
        detail = f"{reason}; given up after {attempts} attempts, look at the worker's log and memory"
        self.fail(job_id, Problem(code=WORKER_DIED, detail=detail))
        return False

    def put_back(self, job_id: str) -> bool:
        """Note that a step was stopped with its worker, which counts for no attempt.

        False when the job had ended or gone, and the step is not wanted any more.
        """
        return self._advance(
            job_id, **_started("stopped with its worker; goes on with the next that is free")
        )

    def _advance(self, job_id: str, **values: Any) -> bool:
        with self._database.write() as session:
            return _changed(session, job_id, values)

    def _end(self, job_id: str, status: JobStatus, **values: Any) -> bool:
        instant = now()
        with self._database.write() as session:
            job = session.get(tables.Job, job_id)
            if job is None:
                return False
            session.get(
                tables.Map, job.map_id, with_for_update=True
            )  # map, then survey, then job: in one order
            if not _changed(
                session, job_id, {**values, "status": status, "finished": instant, "updated": instant}
            ):
                return False
            tallies.tally_job(session, kind=job.kind, status=status, problem=values.get("problem"))
            subject = _subject(session, job)
            if subject is not None:
                subject.status = "ready" if status == "successful" else "failed"
                subject.updated = instant
                if subject.status == "ready":
                    history.note(session, subject)
            return True


def new_job(
    kind: JobKind, map_id: str, survey_id: str | None = None, *, model: str | None = None
) -> tables.Job:
    """Return a job that waits; the caller records it in the transaction of its map, survey or model."""
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
        created=instant,
        updated=instant,
    )


def _started(message: str | None = None) -> dict[str, object]:
    """Return the columns of a job that runs, from this instant on or from an earlier one."""
    instant = now()
    columns = {"status": "running", "started": func.coalesce(tables.Job.started, instant), "updated": instant}
    return columns if message is None else {**columns, "message": message}


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


def _changed(session: Session, job_id: str, values: dict[str, Any]) -> bool:
    statement = update(tables.Job).where(tables.Job.job_id == job_id, _OPEN).values(values)
    return cast("CursorResult[Any]", session.execute(statement)).rowcount == 1
