"""Counts of tiles right and wrong, and the ratios made of them (paper, Section 4.3).

A tile is flagged where its score is above the threshold (Section 3.9.4). A tile without a score (NaN) is never
flagged: nobody was told of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.pipeline.values import Bools

Scores = NDArray[np.floating[Any]]


@dataclass(frozen=True, kw_only=True, slots=True)
class Confusion:
    """Tiles by what was said of them and what is true; two are pooled by `+` (micro-aggregation)."""

    true_positives: int = 0
    false_positives: int = 0
    false_negatives: int = 0
    true_negatives: int = 0
    unobserved: int = 0  #: tiles left out of the four above
    unobserved_changed: int = 0  #: of those, the truly changed

    def __add__(self, other: Confusion) -> Confusion:
        return Confusion(
            true_positives=self.true_positives + other.true_positives,
            false_positives=self.false_positives + other.false_positives,
            false_negatives=self.false_negatives + other.false_negatives,
            true_negatives=self.true_negatives + other.true_negatives,
            unobserved=self.unobserved + other.unobserved,
            unobserved_changed=self.unobserved_changed + other.unobserved_changed,
        )

    @property
    def changed(self) -> int:
        """Truly changed tiles among those counted."""
        return self.true_positives + self.false_negatives

    @property
    def precision(self) -> float:
        """NaN where nothing was flagged."""
        return _ratio(self.true_positives, self.true_positives + self.false_positives)

    @property
    def recall(self) -> float:
        """NaN where nothing changed."""
        return _ratio(self.true_positives, self.changed)

    @property
    def f1(self) -> float:
        """NaN where nothing changed and nothing was flagged."""
        wrong = self.false_positives + self.false_negatives
        return _ratio(2 * self.true_positives, 2 * self.true_positives + wrong)

    @property
    def accuracy(self) -> float:
        """NaN without a tile."""
        right = self.true_positives + self.true_negatives
        return _ratio(right, right + self.false_positives + self.false_negatives)

    @property
    def false_positive_rate(self) -> float:
        """NaN where everything changed."""
        return _ratio(self.false_positives, self.false_positives + self.true_negatives)

    def figures(self) -> dict[str, float | int | None]:
        """All of the above, JSON-ready: None where a ratio has no meaning."""
        ratios = {
            "precision": self.precision,
            "recall": self.recall,
            "f1": self.f1,
            "accuracy": self.accuracy,
            "false_positive_rate": self.false_positive_rate,
        }
        return {
            "true_positives": self.true_positives,
            "false_positives": self.false_positives,
            "false_negatives": self.false_negatives,
            "true_negatives": self.true_negatives,
            "unobserved": self.unobserved,
            "unobserved_changed": self.unobserved_changed,
            **{name: None if np.isnan(value) else round(value, 4) for name, value in ratios.items()},
        }


def confusion(scores: Scores, truth: Bools, threshold: float, observed: Bools | None = None) -> Confusion:
    """Count tiles (T,): those not `observed` apart, all others by whether they are flagged and truly changed."""
    seen = np.ones(len(truth), bool) if observed is None else observed
    flagged = scores > threshold
    return Confusion(
        true_positives=int((flagged & truth & seen).sum()),
        false_positives=int((flagged & ~truth & seen).sum()),
        false_negatives=int((~flagged & truth & seen).sum()),
        true_negatives=int((~flagged & ~truth & seen).sum()),
        unobserved=int((~seen).sum()),
        unobserved_changed=int((~seen & truth).sum()),
    )


def pooled(counts: Iterable[Confusion]) -> Confusion:
    """All counts added up, so that figures are micro-aggregated (paper, Table 5, last row)."""
    return sum(counts, Confusion())


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
