"""The way of a job to its workers: the only file of the service that knows rq.

The queue carries names and ids and nothing else, and is never the record: what a job is and how far it got stands in
the catalog.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from redis import Redis
from redis.backoff import NoBackoff
from redis.exceptions import RedisError, WatchError
from redis.retry import Retry
from rq import Queue
from rq.command import send_stop_job_command
from rq.exceptions import InvalidJobOperation, NoSuchJobError
from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer

from service.catalog.steps import STEPS, JobKind, Step
from service.errors import QueueUnavailable

PATIENCE_S = 2.0  #: a request waits no longer than this for Redis
KEPT_S = 24 * 3600  #: how long rq remembers a step that ended; the catalog keeps the result


def step_id(job_id: str, step: Step) -> str:
    """The name of one step in the queue. rq admits letters, digits, `_` and `-`; a step's name has no `-`."""
    return f"{job_id}-{step.name}"


class JobQueue:
    """Submits and dismisses jobs; safe to share between threads, connects at the first call.

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
        try:
            self._redis.ping()
        except RedisError as error:
            raise _unavailable(error) from error

    def submit(self, job_id: str, kind: JobKind) -> None:
        """Enqueue the steps of a job, all or none; a job that is there already is left as it is."""
        jobs = self._chain(job_id, kind)
        try:
            with self._redis.pipeline() as pipe:
                pipe.watch(jobs[0].key)  # type: ignore[no-untyped-call]
                if pipe.exists(jobs[0].key):
                    return
                pipe.multi()
                for waiting in jobs[1:]:
                    self._defer(waiting, pipe)
                self._queue(jobs[0].origin).enqueue_job(jobs[0], pipeline=pipe)
                pipe.execute()
        except WatchError:  # the same job was submitted between the look and the write
            return
        except RedisError as error:
            raise _unavailable(error) from error

    def dismiss(self, job_id: str, kind: JobKind) -> None:
        """Take back what waits and stop what runs in a geometry worker.

        A running step of the inference queue shares its process with the network and is not killed: it asks the
        catalog between batches whether its job was dismissed. So does a step that starts while this call is made.
        """
        ids = [step_id(job_id, step) for step in self._steps[kind]]
        try:
            found = Job.fetch_many(ids, connection=self._redis, serializer=JSONSerializer)
            for job in reversed([job for job in found if job]):  # the last first: nothing moves up meanwhile
                status = job.get_status(refresh=False)
                if status in (JobStatus.QUEUED, JobStatus.DEFERRED):
                    job.delete()
                elif status == JobStatus.STARTED and job.origin == "geometry":
                    with suppress(InvalidJobOperation, NoSuchJobError):  # it ended just now
                        send_stop_job_command(self._redis, job.id, serializer=JSONSerializer)
        except InvalidJobOperation:  # a step that expired between two looks
            return
        except RedisError as error:
            raise _unavailable(error) from error

    def close(self) -> None:
        """Give the connections back."""
        self._redis.close()

    def _chain(self, job_id: str, kind: JobKind) -> list[Job]:
        """The steps as rq jobs, each waiting for the one before."""
        jobs: list[Job] = []
        for step in self._steps[kind]:
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


def _unavailable(error: RedisError) -> QueueUnavailable:
    """One sentence; the address is left out, for it may hold a password."""
    kind = type(error).__name__
    return QueueUnavailable(
        f"the job queue does not answer ({kind}); nothing was recorded, try again shortly"
    )
