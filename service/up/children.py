"""The worker processes of `spicd up`: started, started again when they end, ended when they hang, and ended together."""

from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Literal, Protocol, Self

from service.up.lifetime import is_stopped, out_of_memory_kills

log = logging.getLogger("spicd")

GRACE_S = 3.0  #: what a running step has after SIGTERM
_LONGEST_WAIT_S = 30.0  #: between two starts of a worker that keeps dying
_HEALTHY_S = 60.0  #: a worker that lived this long starts again at once
_FROZEN_S = 3.0  #: a worker that was stopped (SIGSTOP) for so long is ended
_SILENT_S = 30.0  #: so is one of which the queue has heard nothing for so long, though it had before
_STARTS_S = 180.0  #: a worker that starts is waited for so long, and that longer
_BACK_S = 60.0  #: workers have so long to come back after the queue was away
_LISTEN_S = 2.0  #: between two questions to the queue
_OUTSIDE = (
    -signal.SIGKILL,
    -signal.SIGTERM,
    -signal.SIGINT,
    -signal.SIGHUP,
)  #: what a fault in it does not raise


class Watcher(Protocol):
    """Whom a pool tells and asks about its workers; both may raise, and a pool outlives that."""

    def ended(self, name: str, how: str, *, by_itself: bool) -> None:
        """Take note that a worker has ended; what it had begun goes to another."""

    def answering(self) -> frozenset[str]:
        """Return the names of the workers that gave a sign of life."""


@dataclass(slots=True)
class WorkerProcess:
    """One place in the pool, and the process that holds it now."""

    queue: Literal["geometry", "inference"]
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0  #: monotonic seconds
    deaths: int = 0  #: in a row, each after less than `_HEALTHY_S`
    due: float = 0.0  #: monotonic seconds; not started again before
    name: str = ""  #: of the worker in the queue, another at each start
    heard: float = 0.0  #: monotonic seconds of its last sign of life, or by when the first is waited for
    memory_kills: int = 0  #: of the kernel, when it was started
    ran: float = 0.0  #: monotonic seconds; when it was last seen not stopped

    @property
    def pid(self) -> int:
        """Of the process that holds the place; 0 between two."""
        return self.process.pid if self.process else 0


class WorkerPool:
    """Workers of both queues, as children of this process; use from the main thread (see lifetime.py)."""

    def __init__(
        self,
        *,
        geometry: int,
        inference: int,
        environment: Mapping[str, str],
        program: Sequence[str] = (sys.executable, "-m", "worker"),
        watcher: Watcher | None = None,
    ) -> None:
        self.workers = [WorkerProcess("geometry") for _ in range(geometry)]
        self.workers += [WorkerProcess("inference") for _ in range(inference)]
        self._environment = dict(environment)
        self._program = program
        self._watcher = watcher
        self._numbers = count()
        self._listen = 0.0
        self._ended: list[tuple[str, str, bool]] = []  #: name, how, and whether by itself

    def __enter__(self) -> Self:
        for worker in self.workers:
            self._start(worker)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def check(self) -> None:
        """Reap children that have exited, and start those that are due again; call a few times a second."""
        for worker in self.workers:
            if worker.process is not None and (status := worker.process.poll()) is not None:
                self._reap(worker, status)
            if worker.process is None and time.monotonic() >= worker.due:
                self._start(worker)
        self._tell_of_ended()
        self._end_who_hangs()

    def stop(self) -> None:
        """Send SIGTERM to all, and SIGKILL to who is left after the grace; a killed worker takes its step along."""
        living = [worker.process for worker in self.workers if worker.process is not None]
        for process in living:
            process.terminate()
        until = time.monotonic() + GRACE_S + 2
        for process in living:
            try:
                process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def kill(self) -> None:
        """Send SIGKILL to all, now."""
        for worker in self.workers:
            if worker.process is not None:
                worker.process.kill()

    def _end_who_hangs(self) -> None:
        """Kill workers that are stopped, or that the queue hears nothing of: their steps go to others."""
        instant = time.monotonic()
        self._listen_to_all(instant)
        for worker in self.workers:
            if worker.process is None:
                continue
            if not is_stopped(worker.process.pid):
                worker.ran = instant
            silent = self._watcher is not None and instant - worker.heard > _SILENT_S
            if silent or instant - worker.ran > _FROZEN_S:
                log.warning("the %s worker %d does not answer and is ended", worker.queue, worker.pid)
                worker.process.kill()

    def _listen_to_all(self, instant: float) -> None:
        if self._watcher is None or instant < self._listen:
            return
        self._listen = instant + _LISTEN_S
        try:
            answering = self._watcher.answering()
        except Exception:  # the queue is away: nobody can be heard
            for worker in self.workers:
                worker.heard = instant + _BACK_S
            return
        for worker in self.workers:
            if worker.name in answering:
                worker.heard = instant

    def _start(self, worker: WorkerProcess) -> None:
        worker.name = f"{worker.queue}-{socket.gethostname()}-{os.getpid()}-{next(self._numbers)}"
        options = ["--parent", str(os.getpid()), "--grace", str(GRACE_S), "--name", worker.name]
        # our own program, and a list: no shell reads it
        worker.process = subprocess.Popen(  # noqa: S603  # nosec B603
            [*self._program, worker.queue, *options],
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr.fileno(),  # stdout is the launcher's answer, and libraries print
            start_new_session=True,  # Ctrl-C is for the launcher, which ends its workers in order
        )
        worker.started = worker.ran = time.monotonic()
        worker.memory_kills = out_of_memory_kills()
        worker.heard = worker.started + _STARTS_S

    def _reap(self, worker: WorkerProcess, status: int) -> None:
        lived = time.monotonic() - worker.started
        by_itself = status not in _OUTSIDE or (
            status == -signal.SIGKILL and out_of_memory_kills() > worker.memory_kills
        )
        worker.deaths = worker.deaths + 1 if by_itself and lived <= _HEALTHY_S else 0
        wait = min(2.0**worker.deaths - 1, _LONGEST_WAIT_S)
        log.warning(
            "the %s worker %d ended with %s after %.0f s; starting another in %.0f s",
            worker.queue,
            worker.pid,
            status,
            lived,
            wait,
        )
        worker.process = None
        worker.due = time.monotonic() + wait
        self._ended.append((worker.name, _ending(worker.queue, status), by_itself))

    def _tell_of_ended(self) -> None:
        """Tell the watcher of workers that have ended; others are started before, for this may take seconds."""
        ended, self._ended = self._ended, []
        for name, how, by_itself in ended:
            try:
                if self._watcher is not None:
                    self._watcher.ended(name, how, by_itself=by_itself)
            except Exception as error:
                # catalog or queue are away; what it had begun is found without a claim
                log.warning("%s: %s, which was not recorded: %s", name, how, error)


def _ending(queue: str, status: int) -> str:
    how = f"by signal {signal.Signals(-status).name}" if status < 0 else f"with exit status {status}"
    return f"the {queue} worker that had it ended {how}"
