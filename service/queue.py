"""The way of a job to its workers: the only file of the service that knows rq.

The queue carries names and ids and nothing else, and is never the record: what a job is and how far it got stands in
the catalog.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from redis import Redis
from redis.backoff import NoBackoff
from redis.exceptions import RedisError, WatchError
from redis.retry import Retry
from rq import Queue
from rq.command import send_stop_job_command
from rq.exceptions import InvalidJobOperation, NoSuchJobError
from rq.job import Job, JobStatus
from rq.registry import DeferredJobRegistry
from rq.serializers import JSONSerializer

from service.catalog.steps import STEPS, JobKind, Step
from service.errors import QueueUnavailable

PATIENCE_S = 2.0  #: a request waits no longer than this for Redis
KEPT_S = 24 * 3600  #: how long rq remembers a step that ended; the catalog keeps the result


def step_id(job_id: str, step: Step) -> str:
    """Return the name of one step in the queue. rq admits letters, digits, `_` and `-`; a step's name has no `-`."""
    return f"{job_id}-{step.name}"


class JobQueue:
    """Submits, looks for and dismisses jobs; safe to share between threads, connects at the first call.

    `steps` is another table of steps in tests. Every method raises `QueueUnavailable` when Redis does not answer.
    """

    def __init__(
        self, redis_url: str, *, timeout_s: int = 3600, steps: Mapping[JobKind, Sequence[Step]] = STEPS
    ) -> None:
        self._redis = Redis.from_url(
            redis_url,
            socket_timeout=PATIENCE_S,
            socket_connect_timeout=PATIENCE_S,
            retry=Retry(NoBackoff(), 0),
        )
        self._timeout_s = timeout_s
        self._steps = steps

    def ping(self) -> None:
        """Return when the queue can take jobs."""
        with _redis_errors():
            self._redis.ping()

    def submit(self, job_id: str, kind: JobKind) -> None:
        """Enqueue the steps of a job, all or none; a job that the queue holds is left as it is.

        One that it lost goes on with the first step that had not finished, as far as the queue remembers.
        """
        # a WatchError: the same job was submitted, or moved on, between the look and the write
        with _redis_errors(), suppress(WatchError), self._redis.pipeline() as pipe:
            # every change of a step's state is one of these keys, so who comes between is noticed
            pipe.watch(*(Job.key_for(step_id(job_id, step)) for step in self._steps[kind]))  # type: ignore[no-untyped-call]
            if self._holds(job_id, kind):
                return
            jobs = self._chain(job_id, self._left(job_id, kind))
            pipe.multi()
            for job in jobs:
                self._forget(job, pipe)
            for waiting in jobs[1:]:
                self._defer(waiting, pipe)
            self._queue(jobs[0].origin).enqueue_job(jobs[0], pipeline=pipe)
            pipe.execute()

    def holds(self, job_id: str, kind: JobKind) -> bool:
        """Tell whether a step of the job waits for a worker, or a worker has its claim on one.

        A claim outlives its worker by about a minute; then another worker finds it and asks what to do.
        """
        with _redis_errors():
            return self._holds(job_id, kind)

    def release_claims(self) -> None:
        """Take all claims away: for a caller who knows that no worker is alive, and need not wait until they end."""
        with _redis_errors():
            for name in sorted({step.queue for steps in self._steps.values() for step in steps}):
                queue = self._queue(name)
                self._redis.delete(
                    queue.started_job_registry.key, queue.intermediate_queue_key, queue.registry_cleaning_key
                )

    def dismiss(self, job_id: str, kind: JobKind) -> None:
        """Take back what waits and stop what runs in a geometry worker.

        A running step of the inference queue shares its process with the network and is not killed: it asks the
        catalog between batches whether its job was dismissed. So does a step that starts while this call is made.
        """
        ids = [step_id(job_id, step) for step in self._steps[kind]]
        with _redis_errors(), suppress(InvalidJobOperation):  # a step that expired between two looks
            known = Job.fetch_many(ids, connection=self._redis, serializer=JSONSerializer)
            for job in reversed([job for job in known if job]):  # the last first: nothing moves up meanwhile
                status = job.get_status(refresh=False)
                if status in (JobStatus.QUEUED, JobStatus.DEFERRED):
                    job.delete()
                elif status == JobStatus.STARTED and job.origin == "geometry":
                    with suppress(InvalidJobOperation, NoSuchJobError):  # it ended just now
                        send_stop_job_command(self._redis, job.id, serializer=JSONSerializer)

    def close(self) -> None:
        """Give the connections back."""
        self._redis.close()

    def _holds(self, job_id: str, kind: JobKind) -> bool:
        """Look in the order in which a step moves on, so that none slips by between two looks."""
        for step in self._steps[kind]:
            queue, name = self._queue(step.queue), step_id(job_id, step)
            for waiting in (queue.key, queue.intermediate_queue_key):
                if self._redis.lpos(waiting, name) is not None:
                    return True
            if name in queue.started_job_registry:
                return True
        return False

    def _left(self, job_id: str, kind: JobKind) -> Sequence[Step]:
        """Return the steps from the first that has not finished; all of them where none is known, or none is left."""
        steps = self._steps[kind]
        ids = [step_id(job_id, step) for step in steps]
        known = Job.fetch_many(ids, connection=self._redis, serializer=JSONSerializer)
        for number, job in enumerate(known):
            if job is None or job.get_status(refresh=False) != JobStatus.FINISHED:
                return steps[number:]
        return steps

    def _chain(self, job_id: str, steps: Sequence[Step]) -> list[Job]:
        """Return the steps as rq jobs, each waiting for the one before."""
        jobs: list[Job] = []
        for step in steps:
            jobs.append(
                Job.create(
                    step.function,
                    args=(job_id,),
                    id=step_id(job_id, step),
                    origin=step.queue,
                    depends_on=jobs[-1:] or None,
                    timeout=self._timeout_s,
                    result_ttl=KEPT_S,
                    failure_ttl=KEPT_S,
                    connection=self._redis,
                    serializer=JSONSerializer,
                )
            )
        return jobs

    @staticmethod
    def _forget(job: Job, pipe: Any) -> None:
        """Remove what an earlier submission left of a step."""
        pipe.delete(job.key, job.dependents_key, job.dependencies_key, job.execution_registry.key)
        for registry in (job.finished_job_registry, job.failed_job_registry):
            pipe.zrem(registry.key, job.id)
        DeferredJobRegistry(job.origin, connection=job.connection).remove(job.id, pipeline=pipe)

    def _queue(self, name: str) -> Queue:
        return Queue(name, connection=self._redis, serializer=JSONSerializer)

    @staticmethod
    def _defer(job: Job, pipe: Any) -> None:
        """Park a step until the one before has finished.

        What `rq.Queue.setup_dependencies` does, less its look at the dependency's state: here the dependency is
        written in the same transaction, and a look would end that transaction.
        """
        job.set_status(JobStatus.DEFERRED, pipeline=pipe)
        job.register_dependency(pipeline=pipe)
        job.save(pipeline=pipe)


@contextmanager
def _redis_errors() -> Iterator[None]:
    """Raise QueueUnavailable for an error of Redis: one sentence, without the address, which may hold a password."""
    try:
        yield
    except RedisError as error:
        raise QueueUnavailable(
            f"the job queue does not answer ({type(error).__name__}); nothing was recorded, try again shortly"
        ) from error
