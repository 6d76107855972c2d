"""Threads for calls that block, with a number of their own for each kind: who waits for a lock takes none of a reader's.

The framework runs everything that blocks in one pool of 40 threads. Forty writers that wait for the database would hold
all of it, and a read that needs a millisecond would wait behind them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import anyio
from anyio import to_thread

from service.errors import Unavailable

P = ParamSpec("P")
T = TypeVar("T")

WRITERS = 8  #: more of them wait in the database, which takes one at a time (SQLite) or a few (PostgreSQL)
TURN_S = 5.0  #: how long a request waits for a thread
UPLOAD_TURN_S = 60.0  #: and one that has sent files, which it would have to send again


class Lane:
    """A number of threads; who does not get one in time is told to come again."""

    def __init__(self, size: int = WRITERS, *, turn_s: float = TURN_S) -> None:
        self._turns = anyio.Semaphore(size)
        self._threads = anyio.CapacityLimiter(size)
        self._turn_s = turn_s
        self.calls = 0  #: that wait for a thread or have one

    async def run(self, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call in a thread, and return what it returns. Raises Unavailable where none is free in time."""
        self.calls += 1
        try:
            await self._turn()
            try:
                bound = functools.partial(call, *args, **kwargs)
                return await to_thread.run_sync(bound, limiter=self._threads)
            finally:
                self._turns.release()
        finally:
            self.calls -= 1

    async def _turn(self) -> None:
        with anyio.move_on_after(self._turn_s) as waiting:
            await self._turns.acquire()
        if waiting.cancelled_caught:
            raise Unavailable(f"other writes have taken all turns for {self._turn_s:g} s; try again shortly")
