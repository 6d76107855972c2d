"""Whether a process runs and which it has started, by Linux's /proc, and a wait for a condition."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path


def until(condition: Callable[[], object], seconds: float = 30) -> None:
    """Wait for a condition; fail the test when it does not come true in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def running(pid: int) -> bool:
    """Whether a process is there and has not exited."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def descendants(pid: int) -> Iterator[int]:
    """Yield the processes that a process started, and those that they started."""
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = [int(child) for child in task.read_text().split()]
        except (FileNotFoundError, ProcessLookupError):  # it ended meanwhile
            continue
        for child in children:
            yield child
            yield from descendants(child)
