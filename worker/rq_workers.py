"""The two kinds of worker process.

`GeometryWorker` forks a process for each step, so that a crash in C++ or a lack of memory ends one step and not the
worker. `InferenceWorker` keeps the network in its own memory and never forks (CUDA does not survive one); it may run
several steps at a time, each in a thread.

rq hands out steps, keeps the list of workers, and carries the word that a step is to be stopped. What became of a step
is recorded in the catalog, by the step itself (worker/jobs/step.py) or, where that cannot speak any more, by its
worker. Only then the claim on it is given back, so that who finds a step without a claim knows that nobody has told.
"""

from __future__ import annotations

import logging
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, Protocol

from redis import Redis
from redis.exceptions import RedisError
from rq import Queue, SimpleWorker, Worker, worker_registration
from rq.exceptions import StopRequested
from rq.executions import Execution
from rq.serializers import JSONSerializer
from rq.timeouts import UnixSignalDeathPenalty
from rq.utils import now
from rq.worker.base import BaseWorker, WorkerStatus

from service.errors import Unavailable
from service.logs import about
from service.settings import Settings
from service.up.lifetime import end_with_parent, out_of_memory_kills
from worker.endings import Ending, WorkerStopped, ending_of, ending_of_status
from worker.errors import DeviceLost, PipelineError
from worker.memory import limit_memory
from worker.rq_jobs import FunctionRefused, StepJob, StepTimedOut, step_job
from worker.rq_threads import Door, StepThreads
from worker.watch import Watch

log = logging.getLogger("worker")

HEARTBEAT_S = 4  #: between two signs of life
ANSWERS_S = 20  #: a worker without a sign of life for so long is told as silent
CLAIM_S = 15  #: a claim that was not renewed for so long has ended
LATE_S = 3.0  #: a step that outlasts its time limit by this does not hear its own alarm, and is killed
_TELL_TRIES = 3  #: to tell the catalog how a step ended; each takes some seconds where it does not answer
_LAST_WORDS_S = 10.0  #: that a worker which ends itself has to tell the catalog
_LOOK_S = 1.0  #: between two looks at the processes of a step


class Records(Protocol):
    """What a worker tells the catalog. Each may raise whatever it likes: a worker outlives that."""

    def failed(self, job_id: str, step: str, code: str, sentence: str) -> object:
        """Record that a step ended for good, with this problem."""

    def lost(self, job_id: str, step: str, how: str) -> object:
        """Record that an attempt ended without a word, by its own fault."""

    def interrupted(self, job_id: str, step: str, how: str) -> object:
        """Record that a step ended through no fault of its own."""

    def stopped(self, job_id: str, step: str) -> object:
        """Record that a step was stopped with its worker."""

    def tick(self) -> object:
        """Hand over what is due, and find what was lost."""


_EXPECTED = (PipelineError, FunctionRefused, WorkerStopped, StepTimedOut, Unavailable)


class _StepWorker(BaseWorker):  # type: ignore[misc]  # rq is untyped here
    """What both kinds have in common: the allow-list, the claim, signs of life, and the end of a step."""

    _stopped_job_id: str | None
    max_connection_wait_time = 2.0  #: between two attempts to reach Redis; rq would wait for up to a minute

    def __init__(
        self,
        queue: str,
        connection: Redis,
        *,
        allowed: frozenset[str],
        records: Records,
        grace_s: float,
        name: str | None = None,
    ) -> None:
        super().__init__(
            [queue],
            name=name,
            connection=connection,
            job_class=step_job(allowed),
            serializer=JSONSerializer,
            worker_ttl=15 + HEARTBEAT_S,  # rq waits for a step for 15 s less
            job_monitoring_interval=HEARTBEAT_S,
            maintenance_interval=HEARTBEAT_S,
        )
        self._records = records
        self._grace_s = grace_s
        self._telling = threading.RLock()  #: one at a time tells the catalog
        self._exit = threading.Lock()  #: held by who ends this process

    @property
    def stopping(self) -> bool:
        """Whether the worker was told to end."""
        return bool(self._stop_requested)

    def register_birth(self) -> None:
        """Register, also where an earlier life of this name left its mark: names are given once."""
        self.connection.delete(self.key)
        super().register_birth()

    def heartbeat(self, timeout: int | None = None, pipeline: Any = None) -> None:  # noqa: ARG002  (rq's signature)
        """Give a sign of life; all of it, for Redis may have lost what it knew."""
        self.last_heartbeat = now()
        pipe = self.connection.pipeline() if pipeline is None else pipeline
        pipe.hset(self.key, mapping=self.serialize())
        pipe.expire(self.key, ANSWERS_S)
        worker_registration.register(self, pipe)
        if pipeline is None:
            pipe.execute()

    def maintain_heartbeats(self, job: StepJob) -> None:
        """Give a sign of life, and renew the claim on the step."""
        with self.connection.pipeline() as pipe:
            self.heartbeat(pipeline=pipe)
            if job.claim is not None:
                job.claim.heartbeat(job.started_job_registry, CLAIM_S, pipe)
            pipe.execute()

    def run_maintenance_tasks(self) -> None:
        """Compare catalog and queue, in place of rq's own look at its registries."""
        self._tell(self._records.tick)
        self.last_cleaned_at = now()

    def execute_job(self, job: StepJob, queue: Queue) -> None:
        """Claim a step, have it run, and give the claim back once the catalog knows how it ended."""
        self._claim(job, queue)
        self._carry_out(job)
        with suppress(RedisError):
            self.set_state(WorkerStatus.IDLE)

    def _carry_out(self, job: StepJob) -> None:
        """Have a step run that is claimed, and give the claim back."""
        begun = time.monotonic()
        with about(job_id=job.catalog_id):  # a process that is forked for the step inherits it
            log.info("%s: %s started", self.queues[0].name, job.id)
            try:
                self._work_on(job)
            finally:
                log.info("%s: %s ended after %.1f s", self.queues[0].name, job.id, time.monotonic() - begun)
                with suppress(RedisError):  # the claim ends by itself
                    self._give_back(job)
                self._tell(self._records.tick)

    def _shutdown(self) -> None:
        self._stop_requested = True  # rq notes it of a busy worker only, and tells Redis, which may be away
        if self.get_state() != WorkerStatus.BUSY:
            raise StopRequested

    def handle_warm_shutdown_request(self) -> None:
        """Answer the first SIGTERM: the running step has `grace_s` seconds to end by itself."""
        log.info("%s: stopping", self.queues[0].name)
        timer = threading.Timer(self._grace_s, self._end_grace)
        timer.daemon = True
        timer.start()

    def teardown(self) -> None:
        """End, and also what listens for the word to stop a step, where Redis is away."""
        try:
            super().teardown()
        finally:
            if self.pubsub_thread:
                self.pubsub_thread.stop()

    def _pubsub_exception_handler(self, exc: Exception, *_: object) -> None:
        """Listen on, whatever is wrong with Redis; rq would end at an answer that takes too long."""
        if not isinstance(exc, RedisError):
            raise exc
        time.sleep(self.max_connection_wait_time)

    def _work_on(self, job: StepJob) -> None:
        raise NotImplementedError

    def _end_grace(self) -> None:
        raise NotImplementedError

    def _claim(self, job: StepJob, queue: Queue) -> None:
        with self.connection.pipeline() as pipe:
            job.claim = Execution.create(job, CLAIM_S, pipeline=pipe, worker_name=self.name)
            pipe.lrem(queue.intermediate_queue_key, 0, job.id)
            self.set_current_job_id(job.id, pipeline=pipe)
            self.set_state(WorkerStatus.BUSY, pipeline=pipe)
            pipe.execute()

    def _give_back(self, job: StepJob) -> None:
        if job.claim is None:
            return
        with self.connection.pipeline() as pipe:
            job.claim.delete(job=job, pipeline=pipe)
            pipe.delete(job.key)
            self.set_current_job_id(None, pipeline=pipe)
            pipe.execute()
        job.claim = None

    def _run(self, job: StepJob) -> None:
        """Call the step under its time limit; record what it could not record itself."""
        try:
            with self._limited(job):
                job.run()
        except BaseException as error:
            expected = isinstance(error, _EXPECTED)
            log.error("%s failed: %s", job.id, error, exc_info=None if expected else error)
            ending, lost = ending_of(error, job), DeviceLost.is_told_by(error)
        else:
            return
        if lost:
            self._leave_device(job, ending)
        self._record(job, ending)

    def _leave_device(self, job: StepJob, ending: Ending) -> None:
        """End this process where it would run further steps on a device that it has lost."""

    def _limited(self, job: StepJob) -> AbstractContextManager[object]:
        """Return a block that raises StepTimedOut when the step's time is up."""
        penalty: AbstractContextManager[object] = UnixSignalDeathPenalty(job.timeout, StepTimedOut)
        return penalty

    @contextmanager
    def _alive(self, job: StepJob, *, limit_s: float | None = None) -> Iterator[None]:
        """Give signs of life from a thread for the length of the block.

        A block that takes longer than `limit_s` does not hear its own alarm: the step is recorded as timed out, and this
        process ends.
        """
        over, begun = threading.Event(), time.monotonic()

        def beat() -> None:
            while not over.wait(HEARTBEAT_S):
                if limit_s and time.monotonic() - begun > limit_s:
                    log.error("%s: does not hear that its time is up; this worker ends", job.id)
                    why = f"step {job.id} did not hear that its time was up"
                    self._end_with(job, ending_of(StepTimedOut(), job), why)
                with suppress(RedisError):
                    self.maintain_heartbeats(job)

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join(ANSWERS_S)  # no sign of life may come after the claim was given back

    def _end_with(self, job: StepJob, ending: Ending, why: str) -> None:
        """Record how a step ended, and end this process, which is of no use to others either."""
        last = threading.Timer(_LAST_WORDS_S, os._exit, (1,))
        last.daemon = True
        last.start()
        with self._exit:  # who comes second is recorded by the first, and waits for the end
            self._record(job, ending)
            self._before_exit(job, why)
            os._exit(1)

    def _before_exit(self, job: StepJob, why: str) -> None:
        """Take leave of whatever else runs in this process."""

    def _record(self, job: StepJob, ending: Ending) -> None:
        """Tell the catalog how a step ended."""
        if job.catalog_id is None or ending.how == "dismissed":
            return
        of = (job.catalog_id, job.step)
        for _ in range(_TELL_TRIES):
            match ending.how:
                case "failed":
                    told = self._tell(self._records.failed, *of, ending.code, ending.sentence)
                case "lost":
                    told = self._tell(self._records.lost, *of, ending.sentence)
                case "interrupted":
                    told = self._tell(self._records.interrupted, *of, ending.sentence)
                case _:
                    told = self._tell(self._records.stopped, *of)
            if told:
                return

    def _tell(self, record: Any, *words: str) -> bool:
        """Call the catalog, and tell whether it listened; one that does not answer must not take the worker down.

        What it did not hear, a dispatcher finds: a step that has begun, and on which nobody has a claim.
        """
        try:
            with self._telling:
                record(*words)
            return True
        except StopRequested:
            raise
        except Exception as error:
            log.warning("%s: the catalog was not told (%s): %s", self.queues[0].name, " ".join(words), error)
            return False


class GeometryWorker(_StepWorker, Worker):  # type: ignore[misc]
    """One forked process for each step."""

    def main_work_horse(self, job: StepJob, queue: Queue) -> None:  # noqa: ARG002  (rq's signature)
        """Run the step in the forked process, which ends with the worker, whatever ends that."""
        try:
            end_with_parent(self.pid)
            limit_memory(Settings().step_memory_bytes)
            random.seed()
            self.setup_work_horse_signals()
            self._is_horse = True
            self._run(job)
        except BaseException:
            log.exception("%s: cannot be run", job.id)
            os._exit(1)
        os._exit(0)

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

    def _work_on(self, job: StepJob) -> None:
        killed_before = out_of_memory_kills()
        self.fork_work_horse(job, None)
        try:
            ending, status = self._wait(job)
        except BaseException:  # nobody would watch the step any more
            self.kill_horse()
            with suppress(ChildProcessError):
                os.waitpid(self.horse_pid, 0)
            raise
        finally:
            self._end_group()
        if ending is None and status == 0:
            return  # it has told the catalog itself
        if self._stop_requested:
            ending = Ending(how="stopped")
        elif self._stopped_job_id == job.id:
            self._stopped_job_id, ending = None, Ending(how="dismissed")
        if ending is None:
            ending = ending_of_status(status, job, out_of_memory=out_of_memory_kills() > killed_before)
        if ending.sentence:
            log.warning("%s: %s", job.id, ending.sentence)
        with self._alive(job):
            self._record(job, ending)

    def _wait(self, job: StepJob) -> tuple[Ending | None, int]:
        """Wait for the step's process, and kill it when its time is up or when it hangs; return its wait status."""
        begun, watch, ending = time.monotonic(), Watch(self.horse_pid), None
        look = beat = begun
        while True:
            pid, status, _ = os.wait4(self.horse_pid, os.WNOHANG)
            if pid:
                return ending, status
            instant = time.monotonic()
            if ending is None and instant >= look:
                look = instant + _LOOK_S
                ending = self._due_end(job, instant - begun, watch)
                if ending is not None:
                    self.kill_horse()
            if instant >= beat:
                beat = instant + HEARTBEAT_S
                with suppress(RedisError):  # the step goes on without; it is the catalog that counts
                    self.maintain_heartbeats(job)
            time.sleep(min(0.1, 0.01 + (instant - begun) / 20))

    def _due_end(self, job: StepJob, ran_s: float, watch: Watch) -> Ending | None:
        """Return why a step has to be ended; None while it may go on."""
        if job.timeout and ran_s > job.timeout + LATE_S:
            return ending_of(StepTimedOut(), job)
        trouble = watch.trouble()
        if trouble is None:
            return None
        what, from_outside = trouble
        return Ending(how="interrupted" if from_outside else "lost", sentence=f"step {job.id} {what}")

    def _end_group(self) -> None:
        """Kill what the step's process started and left behind."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.horse_pid, signal.SIGKILL)
        self._horse_pid = 0

    def _end_grace(self) -> None:
        self.kill_horse()


class InferenceWorker(_StepWorker, SimpleWorker):  # type: ignore[misc]
    """One process that stays warm; a thread keeps its claim alive while it works.

    With a `concurrency` above 1 it takes so many steps at a time and runs each in a thread, so that what they ask of the
    network can be batched. All else of a step is as it is alone: its claim, its time limit, its end.
    """

    def __init__(
        self,
        queue: str,
        connection: Redis,
        *,
        concurrency: int = 1,
        tells: Callable[[], Mapping[str, int]] = dict,
        **others: Any,
    ) -> None:
        """`tells` says what stands beside each sign of life, for `service.queue.JobQueue.snapshot`."""
        super().__init__(queue, connection, **others)
        self._tells = tells
        self._steps = StepThreads(concurrency) if concurrency > 1 else None
        self._here = threading.local()  #: the door of a thread's step
        self._jobs: list[StepJob] = []  #: that run in threads

    def serialize(self) -> dict[str, Any]:
        """Return what stands in Redis of this worker."""
        return {**super().serialize(), **self._tells()}

    def execute_job(self, job: StepJob, queue: Queue) -> None:
        """Run a step to its end, or with others: then start it, and return when there is room for the next."""
        if self._steps is None:
            super().execute_job(job, queue)
            return
        self._claim(job, queue)
        self._steps.start(lambda door: self._carry_out_in_thread(job, door), str(job.id))
        self._tell(self._records.tick)  # the next one comes at once
        self._steps.wait_for_room(lambda: self.stopping)

    def request_force_stop(self, *_: Any) -> None:
        """Leave every step from wherever it is: time is up."""
        if self._steps is None:
            raise WorkerStopped
        self._steps.leave(WorkerStopped)

    def teardown(self) -> None:
        """End, once the steps have: each was told to leave when its grace is over."""
        if self._steps is not None:
            self._state = WorkerStatus.BUSY  # a signal that comes now is noted, and does not end the wait
            self._steps.wait_for_all()
        super().teardown()

    def _carry_out_in_thread(self, job: StepJob, door: Door) -> None:
        self._here.door = door
        self._jobs.append(job)
        try:
            self._carry_out(job)
        finally:
            self._jobs.remove(job)

    def _work_on(self, job: StepJob) -> None:
        with self._alive(job, limit_s=job.timeout and job.timeout + LATE_S):
            self._run(job)

    def _limited(self, job: StepJob) -> AbstractContextManager[object]:
        return super()._limited(job) if self._steps is None else self._limited_in_thread(job, self._here.door)

    @contextmanager
    def _limited_in_thread(self, job: StepJob, door: Door) -> Iterator[None]:
        """Have the step's thread leave when its time is up: a thread hears no signal."""
        timer = threading.Timer(job.timeout, door.leave, (StepTimedOut,)) if job.timeout else None
        if timer is not None:
            timer.daemon = True
            timer.start()
        try:
            with door:
                yield
        finally:
            door.shut()
            if timer is not None:
                timer.cancel()

    def _leave_device(self, job: StepJob, ending: Ending) -> None:
        """End: each later step would fail as this one did, and a new process has the device anew."""
        log.error("%s: the device of its networks is lost; this worker ends", job.id)
        self._end_with(job, ending, f"step {job.id} lost the device of the networks")

    def _before_exit(self, job: StepJob, why: str) -> None:
        """Have the other steps run elsewhere: it is not their fault."""
        for other in [other for other in self._jobs if other is not job]:
            self._record(other, Ending(how="interrupted", sentence=f"its worker ended, for {why}"))

    def _end_grace(self) -> None:
        """Signal the main thread, which runs the step; the handler is `request_force_stop` by now."""
        os.kill(os.getpid(), signal.SIGTERM)
