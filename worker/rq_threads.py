"""Steps in threads of one process, each of which can be left from outside.

What a signal does to the main thread, an exception that is raised in a thread does to that thread (CPython's
`PyThreadState_SetAsyncExc`): it is raised before its next instruction of Python, so not within a native call.
"""

from __future__ import annotations

import ctypes
import logging
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

log = logging.getLogger("worker")

_raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc
_raise_in.argtypes = (ctypes.c_ulong, ctypes.py_object)


class Door:
    """A block of a thread that others may have it leave by an error; entered once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._thread = 0

    def __enter__(self) -> Self:
        self._thread = threading.get_ident()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.shut()

    def leave(self, error: type[BaseException]) -> None:
        """Raise an error in the thread, unless it has left the block."""
        with self._lock:
            if self._thread:
                _raise_in(self._thread, error)

    def shut(self) -> None:
        """Let nothing in any more; what comes just now is dropped, for the block is over."""
        while self._thread:
            try:
                with self._lock:
                    mine, self._thread = self._thread, 0
                    _raise_in(mine, ctypes.py_object())  # what was sent and not yet raised
            except BaseException:  # noqa: S112 - it was raised here; nothing else can be
                continue


class StepThreads:
    """Up to so many steps at a time, each in a thread of its own."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._changed = threading.Condition()
        self._doors: dict[threading.Thread, Door] = {}

    @property
    def running(self) -> int:
        """How many run now."""
        with self._changed:
            return len(self._doors)

    def start(self, run: Callable[[Door], None], name: str) -> None:
        """Run something in a thread; it passes through the door what may be left."""
        door = Door()

        def whole() -> None:
            try:
                run(door)
            except BaseException:
                log.exception("%s: cannot be run", name)
            finally:
                with self._changed:
                    self._doors.pop(thread, None)
                    self._changed.notify_all()

        thread = threading.Thread(target=whole, name=name, daemon=True)
        with self._changed:
            self._doors[thread] = door
        thread.start()

    def wait_for_room(self, unless: Callable[[], bool]) -> None:
        """Return when another one may be started, or `unless` says that none will be."""
        self._wait(lambda: len(self._doors) < self._most or unless())

    def wait_for_all(self) -> None:
        """Return when none runs any more."""
        self._wait(lambda: not self._doors)

    def leave(self, error: type[BaseException]) -> None:
        """Raise an error in every step."""
        with self._changed:
            doors = list(self._doors.values())
        for door in doors:
            door.leave(error)

    def _wait(self, over: Callable[[], bool]) -> None:
        """Wait in small pieces: what the handler of a signal changes wakes nobody."""
        with self._changed:
            while not over():
                self._changed.wait(0.2)
