"""The two kinds of worker process.

`GeometryWorker` forks a process for each step, so that a crash in C++ or a lack of memory ends one step and not the
worker. `InferenceWorker` keeps the network in its own memory and never forks (CUDA does not survive one).

Both tell the catalog when a step ended without having said why; what the step itself recorded stands. A step whose
process or worker died is started again where the catalog says so, and one that was stopped with its worker waits for
the next. A step that took too long or raised is not: with the same scans it would do so again.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

from redis import Redis
from redis.exceptions import RedisError
from rq import Queue, SimpleWorker, Worker
from rq.exceptions import AbandonedJobError
from rq.job import JobStatus
from rq.serializers import JSONSerializer
from rq.timeouts import JobTimeoutException
from rq.worker.base import BaseWorker

from service.logs import about
from service.up.lifetime import end_with_parent
from worker.errors import PipelineError
from worker.rq_jobs import FunctionRefused, StepJob, step_job

log = logging.getLogger("worker")

# With rq's defaults a job of a dead worker is found after 7 minutes. Here the worker's claim on a step ends 65 s
# after its last sign of life (interval + 60, in rq), and an idle worker looks every 5 s.
WORKER_TTL_S = 20
HEARTBEAT_S = 5


class Records(Protocol):
    """What a worker tells the catalog, and asks it."""

    def failed(self, job_id: str, code: str, sentence: str) -> object:
        """Record that a step ended for good, with this problem."""

    def lost(self, job_id: str, how: str) -> bool:
        """Record that an attempt ended without a word; tell whether to start the step again."""

    def stopped(self, job_id: str) -> bool:
        """Record that a step was stopped with its worker; tell whether it shall go on with another."""


class WorkerStopped(BaseException):
    """The worker was told to end and its time is up. Not an `Exception`, so that no step swallows it."""


class _StepWorker(BaseWorker):  # type: ignore[misc]  # rq is untyped here
    """What both kinds have in common: the allow-list, the end of a step, and the end of the worker."""

    def __init__(
        self, queue: str, connection: Redis, *, allowed: frozenset[str], records: Records, grace_s: float
    ) -> None:
        super().__init__(
            [queue],
            connection=connection,
            job_class=step_job(allowed),
            serializer=JSONSerializer,
            worker_ttl=WORKER_TTL_S,
            job_monitoring_interval=HEARTBEAT_S,
            maintenance_interval=HEARTBEAT_S,
            exception_handlers=[self._record],
        )
        self._records = records
        self._grace_s = grace_s

    def execute_job(self, job: StepJob, queue: Queue) -> None:
        begun = time.monotonic()
        with about(job_id=job.catalog_id):  # a process that is forked for the step inherits it
            log.info("%s: %s started", self.queues[0].name, job.id)
            super().execute_job(job, queue)
            log.info("%s: %s ended after %.1f s", self.queues[0].name, job.id, time.monotonic() - begun)

    def handle_exception(self, job: StepJob, *exc_info: Any) -> None:
        """Log a user's error in one line and ours with its traceback, then record it."""
        expected = isinstance(exc_info[1], PipelineError | FunctionRefused | WorkerStopped)
        log.error("%s failed: %s", job.id, exc_info[1], exc_info=None if expected else exc_info)
        self._record(job, *exc_info)

    def handle_job_failure(self, job: StepJob, queue: Queue, *args: Any, **kwargs: Any) -> None:
        """Forget the steps behind one that failed for good: rq does not run them, and would keep them for ever."""
        if self.execution is None and job.get_status(refresh=False) == JobStatus.QUEUED:
            self._lost(job, _gone(job))  # rq found it between queue and worker: that one died before it began
        if not job.should_retry:
            job.drop_dependents()
        super().handle_job_failure(job, queue, *args, **kwargs)

    def handle_warm_shutdown_request(self) -> None:
        """Answer the first SIGTERM: the running step has `grace_s` seconds to end by itself."""
        log.info("%s: stopping", self.queues[0].name)
        timer = threading.Timer(self._grace_s, self._end_grace)
        timer.daemon = True
        timer.start()

    def _end_grace(self) -> None:
        raise NotImplementedError

    def _record(self, job: StepJob, kind: type[BaseException], error: BaseException, *_: Any) -> None:
        """Handle a step that raised, or whose worker went away; rq calls this."""
        if kind is AbandonedJobError:
            self._lost(job, _gone(job))
            if not job.should_retry:
                job.drop_dependents()
        elif kind is WorkerStopped:
            self._put_back(job)
        else:
            self._tell(job, self._records.failed, *_problem(error, job))

    def _lost(self, job: StepJob, how: str) -> None:
        """Record an attempt that ended without a word, and start the step again where it shall be."""
        log.warning("%s: %s", job.id, how)
        if self._tell(job, self._records.lost, how):
            job.start_again()

    def _put_back(self, job: StepJob) -> None:
        """Put back a step that ends with this worker, through no fault of its own."""
        if self._tell(job, self._records.stopped):
            job.start_again()

    def _tell(self, job: StepJob, record: Callable[..., object], *words: str) -> bool:
        """Return the catalog's answer; one that does not answer must not take the worker down.

        What it did not hear, it learns when the service next starts and finds the job running without a step.
        """
        if job.catalog_id is None:
            return False
        try:
            return bool(record(job.catalog_id, *words))
        except Exception:
            log.exception("%s: the catalog did not take how it ended", job.id)
            return False


class GeometryWorker(_StepWorker, Worker):  # type: ignore[misc]
    """One forked process for each step."""

    def main_work_horse(self, job: StepJob, queue: Queue) -> None:
        """Run the step in the forked process, which ends with the worker, whatever ends that."""
        end_with_parent(self.pid)
        super().main_work_horse(job, queue)

    def kill_horse(self, sig: signal.Signals = signal.SIGKILL) -> None:
        """Kill the step's process group, and never another: rq asks for the group of pid 0 once the step is over."""
        pid = self.horse_pid
        if not pid:
            return
        with suppress(ProcessLookupError):
            if os.getpgid(pid) == pid:
                os.killpg(pid, sig)
            else:  # it has not made its own group yet
                os.kill(pid, sig)

    def handle_work_horse_killed(
        self,
        job: StepJob,
        pid: int | None,  # noqa: ARG002  (rq's signature)
        status: int | None,
        usage: Any,  # noqa: ARG002
    ) -> None:
        """Handle a process that ended without a word: a crash, no memory, or this worker's end."""
        if self._stop_requested:
            self._put_back(job)
        elif status is None:
            self._tell(job, self._records.failed, *_problem(JobTimeoutException(), job))
        else:
            self._lost(job, f"the process of step {job.id} ended {_ending(status)}")

    def _end_grace(self) -> None:
        self.kill_horse()


class InferenceWorker(_StepWorker, SimpleWorker):  # type: ignore[misc]
    """One process that stays warm; a thread keeps its claim alive while it works."""

    _working: threading.Event | None = None  #: set when the running step is over

    def get_heartbeat_ttl(self, job: StepJob) -> int:
        """Return the forking worker's claim, not `SimpleWorker`'s, which lasts as long as the step may take."""
        return int(BaseWorker.get_heartbeat_ttl(self, job))

    def perform_job(self, job: StepJob, queue: Queue) -> bool:
        self._working = threading.Event()
        threading.Thread(target=self._beat, args=(job, self._working), daemon=True).start()
        try:
            return bool(super().perform_job(job, queue))
        finally:
            self._working.set()

    def handle_execution_ended(self, job: StepJob, queue: Queue, heartbeat_ttl: int) -> None:
        """End the signs of life: the work is done, rq is about to remove its claim, and none may come after that."""
        if self._working is not None:
            self._working.set()
        super().handle_execution_ended(job, queue, heartbeat_ttl)

    def request_force_stop(self, *_: Any) -> None:
        """Leave the step from wherever it is: time is up."""
        raise WorkerStopped

    def _beat(self, job: StepJob, over: threading.Event) -> None:
        while not over.wait(HEARTBEAT_S):
            with suppress(RedisError, AttributeError):  # Redis is away; the claim was removed just now
                self.maintain_heartbeats(job)

    def _end_grace(self) -> None:
        """Signal the main thread, which runs the step; the handler is `request_force_stop` by now."""
        os.kill(os.getpid(), signal.SIGTERM)


def _problem(error: BaseException, job: StepJob) -> tuple[str, str]:
    """Return code and sentence for an error that left a step."""
    match error:
        case PipelineError():
            return error.code, str(error)
        case FunctionRefused():
            return "function_refused", str(error)
        case JobTimeoutException():
            return "timed_out", f"step {job.id} took longer than {job.timeout} s; send fewer or smaller scans"
        case _:
            return (
                "internal",
                f"step {job.id} stopped on an unexpected {type(error).__name__}; see the worker's log",
            )


def _gone(job: StepJob) -> str:
    return f"the worker of step {job.id} went away"


def _ending(status: int) -> str:
    """Say how a process ended, from its wait status."""
    if not os.WIFSIGNALED(status):
        return f"with exit status {os.waitstatus_to_exitcode(status)}"
    number = os.WTERMSIG(status)
    why = " (often: out of memory)" if number == signal.SIGKILL else ""
    return f"by signal {signal.Signals(number).name}{why}"
