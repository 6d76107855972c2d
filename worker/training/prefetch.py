"""Makes the next items while the last one is used."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")
_END = object()


def prefetched(items: Iterable[T], ahead: int = 4) -> Iterator[T]:
    """Return the same items in the same order, made by one thread up to `ahead` in advance.

    An exception in the making is raised here. Leaving the loop early ends the thread.
    """
    ready: queue.Queue[object] = queue.Queue(maxsize=ahead)
    stopped = threading.Event()

    def offer(item: object) -> None:
        while not stopped.is_set():
            try:
                ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return

    def make() -> None:
        try:
            for item in items:
                offer(item)
                if stopped.is_set():
                    return
            offer(_END)
        except BaseException as failure:
            offer(_Failure(failure))

    maker = threading.Thread(target=make, name="prefetch", daemon=True)
    maker.start()
    try:
        while (item := ready.get()) is not _END:
            if isinstance(item, _Failure):
                raise item.cause
            yield item  # type: ignore[misc]
    finally:
        stopped.set()
        maker.join()


class _Failure:
    def __init__(self, cause: BaseException) -> None:
        self.cause = cause
