"""Turns the stages of one step into the progress of the whole job, and a dismissal into a stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from worker.errors import Cancelled

_INTERVAL_S = 0.3  # between two writes to the database, unless a stage ends


class Reporter:
    """A `worker.progress.Progress` that writes where the job is, seldom enough to cost nothing."""

    def __init__(self, spans: Mapping[str, tuple[float, float]], write: Callable[[str, float], bool]) -> None:
        """Take of each stage its part of the job, 0..1; `write(stage, share)` says whether to go on."""
        self._spans = spans
        self._write = write
        self._stage = ""
        self._next = 0.0

    def __call__(self, stage: str, share: float) -> None:
        """Report a stage's share, 0..1. Raises Cancelled when nobody waits for the result any more."""
        if stage == self._stage and share < 1 and time.monotonic() < self._next:
            return
        self._stage, self._next = stage, time.monotonic() + _INTERVAL_S
        begin, end = self._spans[stage]
        if not self._write(stage, begin + (end - begin) * share):
            raise Cancelled("the job was dismissed")
