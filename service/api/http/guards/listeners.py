"""Who listens for events: one look at the log for all of them in this process, and no thread or connection of theirs.

A task asks the log for what is new, some times a second and only while somebody listens, and wakes whoever waits. The
latest events stay in memory; who is behind them reads the log itself, a few at a time.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import Iterator
from functools import partial

from anyio import CapacityLimiter, to_thread

from service.catalog.following.events import EventFilter, EventPage, Events
from service.catalog.records import EventRecord
from service.errors import Gone, Unavailable

log = logging.getLogger(__name__)

EVERY_S = 0.25  #: between two looks
_AT_ONCE = 500  #: events of one look
_KEPT = 2000  #: events in memory
_READERS = 4  #: threads of those that are behind


class Listeners:
    """The listeners of one process. All of it but `end` belongs to the event loop."""

    def __init__(self, events: Events, *, most: int) -> None:
        self._events, self._most = events, most
        self._tail: deque[EventRecord] = deque(maxlen=_KEPT)
        self._head: int | None = (
            None  #: number of the last event in the tail, or of the log when it was empty
        )
        self._news = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._readers = CapacityLimiter(_READERS)
        self.count = 0
        self.ended = False

    def require_room(self) -> None:
        """Raise Unavailable where as many listen as may, or the service ends."""
        if self.ended:
            raise Unavailable("the service ends; listen again when it is back")
        if self.count >= self._most:
            raise Unavailable(f"{self.count} listen for events, as many as may (SPICD_MAX_LISTENERS)")

    @contextlib.contextmanager
    def joined(self) -> Iterator[None]:
        """Listen for as long as the block lasts."""
        self.count += 1
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._look())
        try:
            yield
        finally:
            self.count -= 1

    def end(self) -> None:
        """Have everybody's wait end now, and nobody begin another."""
        self.ended = True
        self._wake()
        if self._task is not None:
            self._task.cancel()

    async def check_map(self, map_id: str) -> None:
        """Raise NotFound for a map of which there is nothing to tell."""
        await to_thread.run_sync(self._events.check_map, map_id, limiter=self._readers)

    async def last(self) -> int:
        """Return the number of the latest event."""
        return await to_thread.run_sync(self._events.last, limiter=self._readers)

    async def next(self, cursor: int, wanted: EventFilter, *, limit: int, wait_s: float) -> EventPage:
        """Return the next events behind a cursor; where there is none, wait for one for so long. Raises Gone."""
        until = time.monotonic() + wait_s
        while True:
            news = self._news
            page = await self._page(cursor, wanted, limit)
            left = until - time.monotonic()
            if page.items or left <= 0 or self.ended:
                return page
            cursor = page.cursor
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(news.wait(), left)

    async def _page(self, cursor: int, wanted: EventFilter, limit: int) -> EventPage:
        """Return what is behind a cursor by now, from memory where all of it is there."""
        head, first = self._head, self._tail[0].sequence if self._tail else None
        if head is not None and (cursor == head or (first is not None and first - 1 <= cursor <= head)):
            found = [event for event in self._tail if event.sequence > cursor and wanted.takes(event)][:limit]
            return EventPage(items=tuple(found), cursor=found[-1].sequence if len(found) == limit else head)
        read = partial(self._events.after, cursor, wanted, limit=limit)
        return await to_thread.run_sync(read, limiter=self._readers)

    async def _look(self) -> None:
        """Read what is new for as long as somebody listens."""
        self._tail.clear()
        self._head = None
        silenced = False
        while self.count and not self.ended:
            try:
                await self._read()
                silenced = False
            except Gone:  # the database was put back to an earlier state
                self._tail.clear()
                self._head = None
            except Exception:  # whatever it is: the next look is another chance
                if not silenced:
                    log.warning("events cannot be read", exc_info=True)
                silenced = True
            await asyncio.sleep(EVERY_S)
        self._head = None
        self._tail.clear()

    async def _read(self) -> None:
        if self._head is None:
            self._head = await self.last()
            self._wake()  # who came before asks again
        while True:
            head = self._head
            page = await to_thread.run_sync(partial(self._events.after, head, limit=_AT_ONCE))
            if page.cursor == head:
                return
            self._tail.extend(page.items)
            self._head = page.cursor
            self._wake()

    def _wake(self) -> None:
        self._news.set()
        self._news = asyncio.Event()
