"""Pairs that were registered already, so that a build that was killed goes on and does not begin anew."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from worker.pipeline.pairwise import PairResult


class PairMemory(Protocol):
    """Keeps results of one build; what it gives back may be any part of what it was given."""

    def load(self) -> Iterable[PairResult]:
        """What an earlier run of this build left."""
        ...

    def save(self, results: Iterable[PairResult]) -> None:
        """Called with a few results at a time, seconds apart at most."""
        ...


class Forgetful:
    """Keeps nothing: for builds that nobody would start again."""

    def load(self) -> Iterable[PairResult]:
        """Nothing."""
        return ()

    def save(self, results: Iterable[PairResult]) -> None:
        """Nothing."""
