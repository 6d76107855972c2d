"""Turns the stages of one step into the progress of the whole job, and a dismissal into a stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from worker.errors import Cancelled, GaveWay

_INTERVAL_S = 0.3  # between two writes to the database, unless a stage ends
_TURN_S = 20.0  # that a build works at least before it gives way


class Turn:
    """Says when a long step shall give way: somebody waits who goes first, and it has worked long enough to have got on.

    What a step does before its first result, such as reading scans, is done again at each of its turns.
    """

    def __init__(
        self, others_wait: Callable[[], bool], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._others_wait, self._clock = others_wait, clock
        self._due: float | None = None  #: a turn lasts from its first result on

    def check(self) -> None:
        """Raise GaveWay when it is time; asks at most once a second. To be called where what was done is kept."""
        if self._due is None:
            self._due = self._clock() + _TURN_S
        if self._clock() < self._due:
            return
        self._due = self._clock() + 1.0
        if self._others_wait():
            raise GaveWay("others go first")


class Reporter:
    """A `worker.progress.Progress` that writes where the job is, seldom enough to cost nothing."""

    def __init__(
        self,
        spans: Mapping[str, tuple[float, float]],
        write: Callable[[str, float], bool],
        *,
        give_way: Mapping[str, Callable[[], None]] | None = None,
    ) -> None:
        """Take of each stage its part of the job, 0..1; `write(stage, share)` says whether to go on.

        `give_way` names the stages that keep what they did, and what is called within them: it may raise GaveWay.
        """
        self._spans = spans
        self._write = write
        self._give_way = give_way or {}
        self._stage = ""
        self._next = 0.0

    def __call__(self, stage: str, share: float) -> None:
        """Report a stage's share, 0..1. Raises Cancelled when nobody waits for the result any more, and GaveWay."""
        if stage == self._stage and share < 1 and time.monotonic() < self._next:
            return
        self._stage, self._next = stage, time.monotonic() + _INTERVAL_S
        begin, end = self._spans[stage]
        if not self._write(stage, begin + (end - begin) * share):
            raise Cancelled("the job was dismissed")
        if 0 < share < 1 and stage in self._give_way:
            self._give_way[stage]()
