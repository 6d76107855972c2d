"""Work spread over processes, because Python's lock and small arrays keep threads from it.

Processes are spawned, never forked: Open3D and OpenMP may have run in the parent, and a fork of that deadlocks.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection
from typing import TypeVar

from worker.errors import ProcessLost
from worker.threads import one_thread, wait_passively

Task = TypeVar("Task")
Result = TypeVar("Result")


class Processes:
    """Runs a function on many tasks; `open_processes` makes and ends it."""

    def __init__(self, pool: ProcessPoolExecutor | None, *, count: int = 1) -> None:
        self._pool = pool
        self.count = count  #: of processes at work; 1: this one alone

    def map_unordered(self, run: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Result]:
        """Yield results as they come, in no order; function, tasks and results have to be picklable.

        Raises what the function raises, and ProcessLost.
        """
        if self._pool is None:
            yield from map(run, tasks)
            return
        futures = [self._pool.submit(run, task) for task in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            raise ProcessLost(
                "a process that registered scans ended without a word (often: out of memory); "
                "give the machine more memory, or the job fewer points"
            ) from None
        finally:
            for future in futures:
                future.cancel()


@contextmanager
def open_processes(count: int) -> Iterator[Processes]:
    """Start so many processes, or none where `count` is under 2: this one does the work then."""
    if count < 2:
        yield Processes(None)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context, initializer=_begin) as pool:
        yield Processes(pool, count=count)


def default_processes() -> int:
    """Return one a core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _begin() -> None:
    """Prepare a new process: one thread for itself, and no life without its parent."""
    wait_passively()
    one_thread()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
