"""Who comes next: steps that are due go to the workers in a fair order, and what a worker lost is due again.

The catalog knows what is due, the queue what workers hold. A dispatcher compares the two. It keeps nothing that
matters, so that any number of them may work at once, in the API, in each worker and in the launcher, and any of them
may be killed anywhere.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timedelta
from typing import Protocol

from service.catalog.jobs import Jobs, OpenJob
from service.catalog.sql.tables import now
from service.catalog.steps import Queue as QueueName
from service.catalog.steps import Step
from service.queue import QUEUES, Claim, Snapshot, step_id, step_of_id

log = logging.getLogger("spicd.dispatch")

TAKEN_S = 5.0  #: a worker claims a step within milliseconds of taking it; after this, it died in between
FORGOTTEN_S = 600.0  #: a worker that was silent for so long is not waited for, nor told of
PATIENCE = timedelta(minutes=2)  #: a build that waited so long goes before surveys that come after it


def fair_order(jobs: Iterable[OpenJob], instant: datetime) -> list[OpenJob]:
    """Return the jobs whose step waits, the one that is next first; `jobs` are all that have not ended.

    What was begun is finished first, and surveys go before builds, and builds before trainings. Among surveys that
    are to begin, owners take turns: who has fewer under way is next. Whoever waited for `PATIENCE` is a survey.
    """
    jobs = list(jobs)
    under_way = Counter(job.owner for job in jobs if job.kind == "survey" and job.status == "running")
    turns: Counter[str] = Counter()
    ranked = []
    for job in sorted(jobs, key=lambda job: (job.due, job.created, job.job_id)):
        if job.begun is not None:
            continue
        rank = _rank(job, instant)
        turn = 0
        if rank == _NEW_SURVEY:
            turn = under_way[job.owner] + turns[job.owner]
            turns[job.owner] += 1
        ranked.append((rank, turn, job.due, job.created, job.job_id, job))
    return [entry[-1] for entry in sorted(ranked)]


_BEGUN_SURVEY, _NEW_SURVEY, _BUILD, _TRAINING = range(4)


def _rank(job: OpenJob, instant: datetime) -> int:
    if job.kind == "survey":
        return _BEGUN_SURVEY if job.status == "running" else _NEW_SURVEY
    if instant - job.due > PATIENCE:
        return _NEW_SURVEY
    return _BUILD if job.kind == "map" else _TRAINING


def queue_positions(jobs: Sequence[OpenJob], instant: datetime) -> dict[str, int]:
    """Return of each job whose step waits how many steps of its queue are not behind it, itself included."""
    positions: dict[str, int] = {}
    behind: Counter[QueueName] = Counter()
    for job in fair_order(jobs, instant):
        queue = job.queue_step.queue
        behind[queue] += 1
        positions[job.job_id] = behind[queue]
    return positions


class Hands(Protocol):
    """What a dispatcher asks of the queue (`service.queue.JobQueue`)."""

    def snapshot(self) -> Snapshot: ...
    def arrange(self, queue: QueueName, wanted: Sequence[tuple[str, Step]]) -> None: ...
    def release(self, claims: Iterable[Claim]) -> None: ...
    def drop_taken(self, queue: QueueName, name: str) -> None: ...
    def forget_worker(self, name: str) -> None: ...


class Dispatcher:
    """Compares catalog and queue. Its methods raise `Unavailable` where either does not answer."""

    def __init__(self, jobs: Jobs, queue: Hands, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._jobs, self._queue, self._clock = jobs, queue, clock
        self._seen: dict[str, float] = {}  #: since when a step is taken, or a worker silent

    def run(self) -> None:
        """Find what was lost, and hand over what is due; call every second, and whenever something changes."""
        try:
            self.recover()
        finally:  # which reads the catalog alone, and goes on where nothing can be written
            self.hand_over()

    def hand_over(self) -> None:
        """Give the workers of each queue as many steps as there are workers, in the fair order.

        Few, so that what comes later can still go first.
        """
        instant = now()
        open_jobs = self._jobs.open_jobs()
        snapshot = self._queue.snapshot()
        order = [job for job in fair_order(open_jobs, instant) if job.due <= instant]
        for name in QUEUES:
            state = snapshot[name]
            held = frozenset(claim.step for claim in state.claims if claim.worker).union(state.taken)
            mine = [(job.job_id, job.queue_step) for job in order if job.queue_step.queue == name]
            free = [(job_id, step) for job_id, step in mine if step_id(job_id, step.name) not in held]
            wanted = free[: max(1, len(state.answering))]
            if tuple(step_id(job_id, step.name) for job_id, step in wanted) != state.waiting:
                self._queue.arrange(name, wanted)

    def recover(self) -> None:
        """Have steps wait again whose workers went away, and forget those workers."""
        running = [job for job in self._jobs.open_jobs() if job.begun is not None]
        snapshot = (
            self._queue.snapshot()
        )  # after the catalog: who ends in between has told it, and is passed over
        for job in running:
            if step_id(job.job_id, job.step) not in snapshot.held:
                how = "the worker that had it went away"
                if self._jobs.interrupt(job.job_id, job.step, how, begun=job.begun):
                    log.warning("step %s of job %s: %s", job.step, job.job_id, how)
        self._clear(snapshot)

    def worker_ended(self, worker: str, how: str, *, by_itself: bool) -> None:
        """Record that a worker has ended, for who saw it: what it had begun waits again, at once.

        `how` is the first half of a sentence. `by_itself`: it crashed, which costs its step an attempt.
        """
        snapshot = self._queue.snapshot()
        claims = [claim for name in QUEUES for claim in snapshot[name].claims if claim.worker == worker]
        begun = {step_id(job.job_id, job.step) for job in self._jobs.open_jobs() if job.begun is not None}
        for claim in claims:
            if claim.step in begun:
                record = self._jobs.lose_attempt if by_itself else self._jobs.interrupt
                record(*step_of_id(claim.step), how)
        self._queue.release(claims)
        for name in QUEUES:
            if worker in snapshot[name].answering + snapshot[name].silent:
                self._drop_taken(name, snapshot, after_s=0.0)
        self._queue.forget_worker(worker)
        self.hand_over()

    def _clear(self, snapshot: Snapshot) -> None:
        """Remove from the queue what dead workers left there."""
        ended = [claim for name in QUEUES for claim in snapshot[name].claims if claim.worker is None]
        if ended:
            self._queue.release(ended)
        silent = {worker for name in QUEUES for worker in snapshot[name].silent}
        taken = {step for name in QUEUES for step in snapshot[name].taken}
        self._seen = {name: since for name, since in self._seen.items() if name in silent | taken}
        for worker in silent:
            if self._age(worker) > FORGOTTEN_S:
                self._queue.forget_worker(worker)
        for name in QUEUES:
            self._drop_taken(name, snapshot, after_s=TAKEN_S)

    def _drop_taken(self, name: QueueName, snapshot: Snapshot, *, after_s: float) -> None:
        """Forget steps that were taken and not claimed for so long; those that wait are handed over again."""
        claimed = {claim.step for claim in snapshot[name].claims}
        for step in snapshot[name].taken:
            if step in claimed or self._age(step) >= after_s:
                self._queue.drop_taken(name, step)

    def _age(self, name: str) -> float:
        """Return for how many seconds this dispatcher has seen it so."""
        return self._clock() - self._seen.setdefault(name, self._clock())
