"""How long work reports where it is, and how it is told to stop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Progress(Protocol):
    """Called between small steps with the stage's name and the share of it that is done.

    `share` is 0..1 and never falls within a stage. An implementation may raise `worker.errors.Cancelled`;
    the caller lets it pass.
    """

    def __call__(self, stage: str, share: float) -> None: ...


def no_progress(stage: str, share: float) -> None:
    """Report nothing."""


def monotonic_progress(progress: Progress) -> Progress:
    """Return the same for work whose rounds begin anew: a share that would fall is reported as the highest so far."""
    highest: dict[str, float] = {}

    def report(stage: str, share: float) -> None:
        highest[stage] = max(highest.get(stage, 0.0), share)
        progress(stage, highest[stage])

    return report


def advancing(
    progress: Progress, stage: str, begin: float, end: float, *, half: int = 60
) -> Callable[[], None]:
    """Return what is called before every small step of work whose length nobody knows, to report that it goes on.

    The share goes from `begin` towards `end`, 0..1, ever more slowly: half of the way after `half` steps, two thirds
    after twice as many. It never reaches `end`, which whoever ends the work reports.
    """
    steps = 0

    def step() -> None:
        nonlocal steps
        progress(stage, begin + (end - begin) * steps / (steps + half))
        steps += 1

    return step
