"""How long work reports where it is, and how it is told to stop."""

from __future__ import annotations

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
