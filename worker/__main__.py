"""Starts one worker: `python -m worker geometry` or `python -m worker inference`.

`python -m worker alive geometry` tells whether one of this host answers, for health checks of containers, and
`python -m worker check inference` whether this machine has the device that it would run on.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol
from uuid import uuid4

from redis import Redis
from redis.exceptions import RedisError

from service.catalog.jobs import Jobs
from service.catalog.records import Problem
from service.catalog.sql.database import Database
from service.catalog.sql.patience import SUPERVISION
from service.catalog.steps import ALLOWED_FUNCTIONS
from service.catalog.tallies import InferenceCounts, tally_inference
from service.dispatch import Dispatcher
from service.errors import QueueUnavailable
from service.logs import set_up_logging
from service.permissions import PRIVATE_UMASK
from service.queue import JobQueue
from service.settings import Settings
from service.up.embedded_redis import LaunchFailed
from service.up.lifetime import end_with_parent
from service.up.requirements import require_model, require_queue
from worker.memory import limit_memory
from worker.rq_workers import GeometryWorker, InferenceWorker
from worker.scratch import shared_temporary, sweep
from worker.threads import wait_passively

log = logging.getLogger("worker")

CONNECT_S = 5.0  #: a connection to Redis takes no longer
AGAIN_S = 1.0  #: between two attempts to reach it

# Imported before the first fork, so that no step pays for it. Importing is all that may happen here: native work in
# the parent starts threads, and a fork among threads that hold locks deadlocks.
WARM_MODULES = {"geometry": ("open3d", "torch", "worker.jobs"), "inference": ("torch", "worker.jobs")}


class Counter(Protocol):
    """What was counted in this process and not written yet (`worker.detectors.running.meter.Meter`)."""

    def take(self) -> InferenceCounts: ...
    def give_back(self, counted: InferenceCounts) -> None: ...


def main(arguments: list[str] | None = None) -> int:
    """Work until told to stop; returns the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    if words[:1] == ["alive"]:
        return alive(words[1:])
    if words[:1] == ["check"]:
        return check(words[1:])
    options = _parse(words)
    if options.parent:
        end_with_parent(options.parent)
    os.umask(PRIVATE_UMASK)
    settings = Settings()
    set_up_logging(settings.log_level, settings.log_format)
    if settings.redis_url is None:
        print(
            "no queue to work on: set SPICD_REDIS_URL, or start everything with `spicd up`", file=sys.stderr
        )
        return 2
    try:
        if options.parent:  # who starts a worker of its own has looked, but a GPU can be lost since
            _require_device(settings, options.queue)
        else:
            _require_all(settings, options.queue)
    except LaunchFailed as error:
        print(error, file=sys.stderr)
        return 2
    wait_passively()
    for module in WARM_MODULES[options.queue]:
        importlib.import_module(module)
    name = options.name or f"{_host(options.queue)}{os.getpid()}-{uuid4().hex[:8]}"
    connect = functools.partial(Redis.from_url, settings.redis_url, socket_connect_timeout=CONNECT_S)
    if options.queue == "geometry":
        log.info("geometry worker is ready")
        work(
            lambda: GeometryWorker("geometry", connect(), **_of_all(options, name, CatalogRecords(settings)))
        )
        return 0
    limit_inference(settings)
    with serving(settings, name) as share:
        log.info("inference worker is ready, steps at a time: %d", share.concurrency)
        own = _of_all(options, name, CatalogRecords(settings, counted=share.counted))
        own |= {"concurrency": share.concurrency, "tells": share.tells}
        work(lambda: InferenceWorker("inference", connect(), **own))
    return 0


def _of_all(options: argparse.Namespace, name: str, records: CatalogRecords) -> dict[str, Any]:
    """Return what a worker of either kind is made with."""
    return {"allowed": ALLOWED_FUNCTIONS, "grace_s": options.grace, "name": name, "records": records}


@dataclass(frozen=True, kw_only=True, slots=True)
class Share:
    """What the steps of an inference worker have in common, as its process sees it."""

    concurrency: int  #: steps at a time
    tells: Callable[[], dict[str, int]]  #: what stands beside the worker's signs of life
    counted: Counter  #: what its networks have counted


@contextlib.contextmanager
def serving(settings: Settings, name: str) -> Iterator[Share]:
    """Prepare what the steps of this process share, for the length of a block."""
    from worker.jobs.models import networks  # noqa: PLC0415  # torch takes seconds

    shared = networks(settings)
    together = shared.concurrency > 1
    with shared_temporary(settings.scratch_dir(), name) if together else contextlib.nullcontext():
        yield Share(concurrency=shared.concurrency, tells=shared.tells, counted=shared.meter)


def alive(arguments: list[str]) -> int:
    """Return 0 where a worker of this host gave a sign of life lately, and where the queue is away; 1 where none did."""
    parser = argparse.ArgumentParser(prog="python -m worker alive", description=alive.__doc__)
    parser.add_argument("queue", choices=sorted(WARM_MODULES))
    queue = parser.parse_args(arguments).queue
    try:
        answering = JobQueue(Settings().redis_url or "").snapshot()[queue].answering
    except QueueUnavailable as error:  # workers outlive it, and to start them again would end their steps
        print(error, file=sys.stderr)
        return 0
    if any(name.startswith(_host(queue)) for name in answering):
        return 0
    print(f"no {queue} worker of {socket.gethostname()} answers", file=sys.stderr)
    return 1


def check(arguments: list[str]) -> int:
    """Return 0 where this machine has what a worker of a queue needs, by SPICD_DEVICE; 2 where not, and say so."""
    parser = argparse.ArgumentParser(prog="python -m worker check", description=check.__doc__)
    parser.add_argument("queue", choices=sorted(WARM_MODULES))
    try:
        _require_device(Settings(), parser.parse_args(arguments).queue)
    except LaunchFailed as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _require_all(settings: Settings, queue: str) -> None:
    """Raise LaunchFailed where the queue does not answer, or what would run the model is not there."""
    require_queue(settings)
    if queue == "inference":
        _require_device(settings, queue)
        require_model(settings)


def _require_device(settings: Settings, queue: str) -> None:
    if queue != "inference" or (settings.device != "cuda" and settings.inference_precision != "bfloat16"):
        return
    from worker.jobs.models import finds_gpu, lacks_precision  # noqa: PLC0415  # torch takes seconds

    if settings.device == "cuda" and not finds_gpu():
        raise LaunchFailed(
            "SPICD_DEVICE is cuda, but torch finds no CUDA GPU; set it to auto or cpu, or mend the driver"
        )
    if lacks_precision(settings):
        raise LaunchFailed(
            "SPICD_INFERENCE_PRECISION is bfloat16, and this machine's device does not have it; set it to auto"
        )


def limit_inference(settings: Settings) -> int:
    """Limit what an inference worker may allocate, as each geometry step is; returns the limit in bytes, 0 for none.

    Not where it has a GPU, of whose memory it gets a share: CUDA maps far more than it uses. The limit is of the process,
    which outlives its steps.
    """
    from worker.jobs.models import take_gpu_share  # noqa: PLC0415  # torch takes seconds

    if take_gpu_share(settings):
        return 0
    return limit_memory(settings.step_memory_bytes)


def _host(queue: str) -> str:
    """Return what the name of each worker of this host begins with."""
    return f"{queue}-{socket.gethostname()}-"


def work(make: Callable[[], GeometryWorker | InferenceWorker]) -> None:
    """Work until told to stop, with a new worker each time that Redis went away."""
    while True:
        worker = None
        try:
            worker = make()
            worker.work()
        except RedisError as error:
            log.warning("the queue does not answer (%s); trying again", type(error).__name__)
        if worker is not None and worker.stopping:
            return
        time.sleep(AGAIN_S)


class CatalogRecords:
    """Tells the catalog how a step ended that could not say so itself, and keeps the queue supplied.

    The database alone is opened, and closed again: this process forks, and the blob store starts threads.
    """

    def __init__(self, settings: Settings, counted: Counter | None = None) -> None:
        self._counted = counted
        self._database = Database(settings.resolved_database_url(), patience=SUPERVISION)
        self._jobs = Jobs(self._database)
        queue = JobQueue(settings.redis_url or "", timeout_s=settings.job_timeout_s)
        self._dispatcher = Dispatcher(self._jobs, queue)
        self._scratch = settings.scratch_dir()

    def failed(self, job_id: str, step: str, code: str, sentence: str) -> None:
        """Record that the job failed with this problem, unless it is at another step by now."""
        with self._opened():
            self._jobs.fail(job_id, Problem(code=code, detail=sentence), step=step)

    def lost(self, job_id: str, step: str, how: str) -> None:
        """Count an attempt."""
        with self._opened():
            self._jobs.lose_attempt(job_id, step, how)

    def interrupted(self, job_id: str, step: str, how: str) -> None:
        """Count an interruption."""
        with self._opened():
            self._jobs.interrupt(job_id, step, how)

    def stopped(self, job_id: str, step: str) -> None:
        """Have the step wait for another worker."""
        with self._opened():
            self._jobs.put_back(job_id, step, "stopped with its worker; goes on with the next that is free")

    def tick(self) -> None:
        """Sweep what killed steps left, find what was lost, and hand over what is due."""
        sweep(self._scratch)
        with self._opened():
            try:
                self._dispatcher.run()
            finally:
                self._write_counted()

    def _write_counted(self) -> None:
        """Write what networks have counted since the last time; where that fails it is counted the next time."""
        counted = {} if self._counted is None else self._counted.take()
        if self._counted is None or not counted:
            return
        try:
            with self._database.write() as session:
                tally_inference(session, counted)
        except Exception:
            self._counted.give_back(counted)
            raise

    @contextlib.contextmanager
    def _opened(self) -> Iterator[None]:
        try:
            yield
        finally:
            self._database.close()


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m worker", description=__doc__)
    parser.add_argument("queue", choices=sorted(WARM_MODULES))
    parser.add_argument(
        "--grace", type=float, default=8.0, help="seconds that a running step has after SIGTERM"
    )
    parser.add_argument("--name", help="of this worker, given once; left out, one is made")
    parser.add_argument(
        "--parent", type=int, default=0, help="end when the process with this id, the parent, ends"
    )
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
