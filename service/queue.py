"""The way of a step to its worker: the only file of the service that knows rq.

The queue carries names and ids and nothing else, and is never the record: what a job is, how far it got and which step
is due stands in the catalog. What waits here is the little that workers take next (service/dispatch.py).

A worker that takes a step moves it from the queue to the list of steps that are taken, then claims it. The claim lasts
as long as the worker renews it, and its key in Redis ends by itself a few seconds after the last time.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from redis import Redis
from redis.backoff import NoBackoff
from redis.exceptions import RedisError, WatchError
from redis.retry import Retry
from rq.command import send_command
from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer
from rq.worker_registration import REDIS_WORKER_KEYS

from service.catalog.steps import STEPS, JobKind, Step
from service.catalog.steps import Queue as QueueName
from service.errors import QueueUnavailable

PATIENCE_S = 2.0  #: a request waits no longer than this for Redis
KEPT_S = 24 * 3600  #: how long rq remembers a step that nobody cleaned up after
QUEUES: tuple[QueueName, ...] = ("geometry", "inference")

_TRIES = 5  #: of a transaction that a change comes between
_WORKER = "rq:worker:"  #: what the key of a worker begins with


def step_id(job_id: str, step: str) -> str:
    """Return the name of one step in the queue. rq admits letters, digits, `_` and `-`; a step's name has no `-`."""
    return f"{job_id}-{step}"


def step_of_id(name: str) -> tuple[str, str]:
    """Return the id of the job and the name of the step."""
    job_id, _, step = name.rpartition("-")
    return job_id, step


@dataclass(frozen=True, kw_only=True, slots=True)
class Claim:
    """A worker's hold on a step."""

    step: str  #: as `step_id` names it
    execution: str  #: of rq, one a run
    worker: str | None  #: name of the worker; None when the claim has ended without being given back

    @property
    def key(self) -> str:
        """Its member in rq's registry of what runs."""
        return f"{self.step}:{self.execution}"


@dataclass(frozen=True, kw_only=True, slots=True)
class QueueState:
    """What one queue holds."""

    waiting: tuple[str, ...] = ()  #: steps that no worker has taken, the next one first
    taken: tuple[str, ...] = ()  #: that a worker has taken and not yet claimed
    claims: tuple[Claim, ...] = ()
    answering: tuple[str, ...] = ()  #: names of the workers that gave a sign of life
    silent: tuple[str, ...] = ()  #: of those that did not, and never said that they end
    models: int = 0  #: that the answering workers keep open
    model_bytes: int = 0  #: of these models' weights

    @property
    def held(self) -> frozenset[str]:
        """Every step that waits, is taken, or has a claim that stands."""
        claimed = (claim.step for claim in self.claims if claim.worker is not None)
        return frozenset((*self.waiting, *self.taken, *claimed))


@dataclass(frozen=True, kw_only=True, slots=True)
class Snapshot:
    """What all queues hold."""

    queues: Mapping[QueueName, QueueState] = field(default_factory=dict)

    def __getitem__(self, queue: QueueName) -> QueueState:
        return self.queues.get(queue) or QueueState()

    @property
    def held(self) -> frozenset[str]:
        """The steps that any queue holds."""
        return frozenset().union(*(state.held for state in self.queues.values()))


class JobQueue:
    """Hands steps over, says what is held, and dismisses; safe to share between threads, connects at the first call.

    Every method raises `QueueUnavailable` when Redis does not answer.
    """

    def __init__(self, redis_url: str, *, timeout_s: int = 3600) -> None:
        self._redis = Redis.from_url(
            redis_url,
            socket_timeout=PATIENCE_S,
            socket_connect_timeout=PATIENCE_S,
            retry=Retry(NoBackoff(), 0),
        )
        self._timeout_s = timeout_s

    def ping(self) -> None:
        """Return when the queue can take jobs."""
        with _redis_errors():
            self._redis.ping()

    def snapshot(self) -> Snapshot:
        """Return what the queues hold, and which workers answer."""
        with _redis_errors():
            return Snapshot(queues={name: self._state(name) for name in QUEUES})

    def arrange(self, queue: QueueName, wanted: Sequence[tuple[str, Step]]) -> None:
        """Have these steps (id of the job, step) wait in this order, and none else.

        A step that a worker has taken or claimed meanwhile is left as it is. Where the queue changes during the call,
        nothing is done: the next call sees it.
        """
        key = _waiting(queue)
        with _redis_errors(), suppress(WatchError), self._redis.pipeline() as pipe:
            pipe.watch(key, _taken(queue), _claims(queue))  # type: ignore[no-untyped-call]
            state = self._state(queue)
            gone = state.held.difference(state.waiting)
            steps = {step_id(job_id, step.name): (job_id, step) for job_id, step in wanted}
            order = [name for name in steps if name not in gone]
            if tuple(order) == state.waiting:
                return
            pipe.multi()
            pipe.delete(key)
            for name in set(state.waiting).difference(order):
                self._forget(name, pipe)
            for name in order:
                if name not in state.waiting:
                    self._forget(name, pipe)
                    self._write(*steps[name], pipe)
                pipe.rpush(key, name)
            pipe.execute()

    def release(self, claims: Iterable[Claim]) -> None:
        """Take claims away that no worker has any more; what is to be known of them is recorded before."""
        with _redis_errors():
            for claim in claims:
                self._remove(claim.step, functools.partial(_drop_claim, claim), but=claim)

    def drop_taken(self, queue: QueueName, name: str) -> None:
        """Forget that a worker has taken a step: it ended before it claimed it."""
        with _redis_errors():
            self._remove(name, lambda pipe: pipe.lrem(_taken(queue), 0, name), taken=True)

    def forget_worker(self, name: str) -> None:
        """Strike a worker that has ended off rq's list."""
        with _redis_errors(), self._redis.pipeline() as pipe:
            for key in (REDIS_WORKER_KEYS, *(f"rq:workers:{queue}" for queue in QUEUES)):
                pipe.srem(key, _WORKER + name)
            pipe.delete(_WORKER + name)
            pipe.execute()

    def release_claims(self) -> None:
        """Take all claims away: for a caller who knows that no worker is alive."""
        with _redis_errors():
            state = {name: self._state(name) for name in QUEUES}
            self.release(claim for queue in state.values() for claim in queue.claims)
            self._redis.delete(*(_taken(name) for name in QUEUES))
            for queue in state.values():
                for worker in (*queue.answering, *queue.silent):
                    self.forget_worker(worker)

    def dismiss(self, job_id: str, kind: JobKind) -> None:
        """Take back what waits and stop what runs in a geometry worker.

        A running step of the inference queue shares its process with the network and is not killed: it asks the
        catalog between batches whether its job was dismissed. So does a step that starts while this call is made.
        """
        with _redis_errors():
            steps = {step_id(job_id, step.name): step.queue for step in STEPS[kind]}
            for name, queue in steps.items():
                if self._redis.lrem(_waiting(queue), 0, name):
                    self._remove(name, lambda _: None)
            for claim in self._state("geometry").claims:
                if claim.step in steps and claim.worker is not None:
                    send_command(self._redis, claim.worker, "stop-job", job_id=claim.step)

    def close(self) -> None:
        """Give the connections back."""
        self._redis.close()

    def _state(self, queue: QueueName) -> QueueState:
        """Look in the order in which a step moves on, so that none slips by between two looks."""
        with self._redis.pipeline(transaction=True) as pipe:
            pipe.lrange(_waiting(queue), 0, -1)
            pipe.lrange(_taken(queue), 0, -1)
            pipe.zrange(_claims(queue), 0, -1)
            pipe.smembers(f"rq:workers:{queue}")
            waiting, taken, claims, workers = pipe.execute()
        claims, workers = _texts(claims), sorted(_texts(workers))
        with self._redis.pipeline(transaction=False) as pipe:
            for claim in claims:
                pipe.hget(f"rq:execution:{claim}", "worker_name")
            for worker in workers:
                pipe.exists(worker)
            for worker in workers:
                pipe.hmget(worker, "models", "model_bytes")
            told = pipe.execute()
        holders, told = told[: len(claims)], told[len(claims) :]
        alive, open_models = told[: len(workers)], told[len(workers) :]
        names = [worker.removeprefix(_WORKER) for worker in workers]
        return QueueState(
            waiting=_texts(waiting),
            taken=_texts(taken),
            claims=tuple(_claim(key, holder) for key, holder in zip(claims, holders, strict=True)),
            answering=tuple(name for name, there in zip(names, alive, strict=True) if there),
            silent=tuple(name for name, there in zip(names, alive, strict=True) if not there),
            models=sum(int(models or 0) for models, _ in open_models),
            model_bytes=sum(int(size or 0) for _, size in open_models),
        )

    def _remove(
        self, name: str, change: Callable[[Any], object], *, but: Claim | None = None, taken: bool = False
    ) -> None:
        """Make a change in one transaction that also removes what rq keeps of a step, unless somebody holds the step.

        The claim `but`, and with `taken` a place among the steps that are taken, do not count. When the queue changes
        meanwhile it is tried again, some times; then who comes next does it.
        """
        for _ in range(_TRIES):
            with suppress(WatchError):
                self._removed(name, change, but=but, taken=taken)
                return

    def _removed(self, name: str, change: Callable[[Any], object], *, but: Claim | None, taken: bool) -> None:
        with self._redis.pipeline() as pipe:
            pipe.watch(*(key(queue) for queue in QUEUES for key in (_waiting, _taken, _claims)))  # type: ignore[no-untyped-call]
            states = [self._state(queue) for queue in QUEUES]
            claimed = {
                claim.step for state in states for claim in state.claims if claim.key != (but and but.key)
            }
            waits = {step for state in states for step in state.waiting + (() if taken else state.taken)}
            pipe.multi()
            if name not in claimed | waits:
                self._forget(name, pipe)
            change(pipe)
            pipe.execute()

    def _write(self, job_id: str, step: Step, pipe: Any) -> None:
        """Write a step as an rq job that is about to wait."""
        job = Job.create(
            step.function,
            args=(job_id,),
            id=step_id(job_id, step.name),
            origin=step.queue,
            timeout=self._timeout_s,
            result_ttl=KEPT_S,
            failure_ttl=KEPT_S,
            status=JobStatus.QUEUED,
            connection=self._redis,
            serializer=JSONSerializer,
        )
        job.save(pipeline=pipe)
        pipe.expire(job.key, 30 * KEPT_S)  # of one that nobody ever takes or forgets

    @staticmethod
    def _forget(name: str, pipe: Any) -> None:
        """Remove what rq keeps of a step."""
        pipe.delete(*(f"{key}:{name}" for key in ("rq:job", "rq:executions", "rq:results")))


def _waiting(queue: str) -> str:
    """Return the key of the list of steps that no worker has taken."""
    return f"rq:queue:{queue}"


def _taken(queue: str) -> str:
    """Return the key of the list between queue and worker (`rq.intermediate_queue`)."""
    return f"rq:queue:{queue}:intermediate"


def _claims(queue: str) -> str:
    """Return the key of the registry of what runs (`rq.registry.StartedJobRegistry`)."""
    return f"rq:wip:{queue}"


def _drop_claim(claim: Claim, pipe: Any) -> None:
    for queue in QUEUES:
        pipe.zrem(_claims(queue), claim.key)
    pipe.delete(f"rq:execution:{claim.key}")


def _claim(key: str, holder: bytes | None) -> Claim:
    step, _, execution = key.rpartition(":")
    return Claim(step=step, execution=execution, worker=None if holder is None else holder.decode())


def _texts(values: Iterable[bytes]) -> tuple[str, ...]:
    return tuple(value.decode() for value in values)


@contextmanager
def _redis_errors() -> Iterator[None]:
    """Raise QueueUnavailable for an error of Redis: one sentence, without the address, which may hold a password."""
    try:
        yield
    except RedisError as error:
        raise QueueUnavailable(
            f"the job queue does not answer ({type(error).__name__}); nothing was recorded, try again shortly"
        ) from error
