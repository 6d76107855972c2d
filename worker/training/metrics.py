"""What a classifier of pairs is measured by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, slots=True)
class Measured:
    """Three-class figures over a set of pairs."""

    loss: float
    accuracy: float
    precision: tuple[float, float, float]  #: of each class; 0 for a class never answered
    recall: tuple[float, float, float]

    @property
    def rank(self) -> tuple[float, float]:
        """Which checkpoint is better: accuracy, then the worst class's precision (paper, Section 3.8)."""
        return self.accuracy, min(self.precision)


def measured(probabilities: NDArray[np.float32], labels: NDArray[np.int64], loss: float) -> Measured:
    """From (n, 3) probabilities and (n,) labels."""
    confusion = np.zeros((3, 3), dtype=np.int64)  # true class, answered class
    np.add.at(confusion, (labels, probabilities.argmax(axis=1)), 1)
    hits = np.diag(confusion)
    precision = (hits / np.maximum(confusion.sum(axis=0), 1)).tolist()
    recall = (hits / np.maximum(confusion.sum(axis=1), 1)).tolist()
    return Measured(
        loss=loss,
        accuracy=float(hits.sum() / max(len(labels), 1)),
        precision=(precision[0], precision[1], precision[2]),
        recall=(recall[0], recall[1], recall[2]),
    )
