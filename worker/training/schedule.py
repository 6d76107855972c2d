"""How far a run is, and the learning rate there."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Schedule:
    """Cosine from `start` to `end` over the run (paper, Section 3.8).

    A run may be bounded by epochs, by wall-clock minutes, or by both; whichever is nearer to its end sets the
    place on the curve, so that the rate has come down when the time is up.
    """

    epochs: int
    minutes: float | None = None
    start: float = 1e-3
    end: float = 1e-5

    def done(self, epochs: float, seconds: float) -> float:
        """Return share 0..1 of the run behind us after so many epochs (fractions count) and seconds."""
        by_time = 0.0 if self.minutes is None else seconds / (60 * self.minutes)
        by_epochs = epochs / self.epochs if self.epochs else 1.0
        return min(max(by_epochs, by_time), 1.0)

    def rate(self, done: float) -> float:
        """Return the learning rate at that share."""
        return self.end + (self.start - self.end) * 0.5 * (1 + math.cos(math.pi * done))
