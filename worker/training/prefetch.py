"""Makes the next items while the last one is used."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")
_END: Any = object()


def prefetched(items: Iterable[T], ahead: int = 4) -> Iterator[T]:
    """Yield the same items in the same order, made by one thread up to `ahead` in advance.

    An exception in the making is raised here. Leaving the loop early ends the thread.
    """
    source = iter(items)
    maker = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    waiting = deque(maker.submit(next, source, _END) for _ in range(ahead))
    try:
        while (item := waiting.popleft().result()) is not _END:
            waiting.append(maker.submit(next, source, _END))
            yield item
    finally:
        maker.shutdown(cancel_futures=True)
