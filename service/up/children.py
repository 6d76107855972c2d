"""The worker processes of `spicd up`: started, started again when they die, and ended together."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Self

log = logging.getLogger("spicd")

GRACE_S = 3.0  #: what a running step has after SIGTERM
_LONGEST_WAIT_S = 30.0  #: between two starts of a worker that keeps dying
_HEALTHY_S = 60.0  #: a worker that lived this long starts again at once


@dataclass(slots=True)
class WorkerProcess:
    """One place in the pool, and the process that holds it now."""

    queue: Literal["geometry", "inference"]
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0  #: monotonic seconds
    deaths: int = 0  #: in a row, each after less than `_HEALTHY_S`
    due: float = 0.0  #: monotonic seconds; not started again before

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
    ) -> None:
        self.workers = [WorkerProcess("geometry") for _ in range(geometry)]
        self.workers += [WorkerProcess("inference") for _ in range(inference)]
        self._environment = dict(environment)
        self._program = program

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

    def _start(self, worker: WorkerProcess) -> None:
        options = ["--parent", str(os.getpid()), "--grace", str(GRACE_S)]
        # our own program, and a list: no shell reads it
        worker.process = subprocess.Popen(  # noqa: S603  # nosec B603
            [*self._program, worker.queue, *options],
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=sys.stderr.fileno(),  # stdout is the launcher's answer, and libraries print
            start_new_session=True,  # Ctrl-C is for the launcher, which ends its workers in order
        )
        worker.started = time.monotonic()

    def _reap(self, worker: WorkerProcess, status: int) -> None:
        lived = time.monotonic() - worker.started
        worker.deaths = 0 if lived > _HEALTHY_S else worker.deaths + 1
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
