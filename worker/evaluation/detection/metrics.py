"""What a detection is measured by: counts at a threshold, curves over it, and the choice of one (paper, Section 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.evaluation.detection.confusion import Confusion, Scores, confusion, pooled
from worker.pipeline.values import Bools, Floats

__all__ = [
    "PAPER_SWEEP",
    "Confusion",
    "Operating",
    "PrecisionRecall",
    "Roc",
    "Scores",
    "Sweep",
    "all_thresholds",
    "best_f1",
    "confusion",
    "pooled",
    "precision_recall",
    "roc",
    "sweep",
]

#: Thresholds that the paper sweeps (Section 3.9.3).
PAPER_SWEEP: Floats = np.round(np.arange(0.10, 0.905, 0.01), 2)


@dataclass(frozen=True, kw_only=True, slots=True)
class Operating:
    """A threshold, and what it does."""

    threshold: float
    counts: Confusion


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Sweep:
    """Counts at each of K thresholds."""

    thresholds: Floats  #: (K,)
    true_positives: NDArray[np.int64]  #: (K,)
    false_positives: NDArray[np.int64]  #: (K,)
    changed: int  #: truly changed tiles
    unchanged: int

    @property
    def recall(self) -> Floats:
        """(K,) NaN where nothing changed."""
        return _ratios(self.true_positives, self.changed)

    @property
    def precision(self) -> Floats:
        """(K,) NaN where nothing is flagged."""
        return _ratios(self.true_positives, self.true_positives + self.false_positives)

    @property
    def f1(self) -> Floats:
        """(K,) 0 where nothing is flagged; NaN where nothing changed either."""
        return _ratios(2 * self.true_positives, self.true_positives + self.false_positives + self.changed)

    @property
    def false_positive_rate(self) -> Floats:
        """(K,) NaN where everything changed."""
        return _ratios(self.false_positives, self.unchanged)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Roc:
    """Receiver operating characteristic, from "nothing flagged" to "everything flagged"."""

    false_positive_rate: Floats  #: (K,) ascending from 0 to 1
    recall: Floats  #: (K,) ascending from 0 to 1
    thresholds: Floats  #: (K,) descending
    area: float  #: chance that a changed tile scores above an unchanged one, ties counting half


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PrecisionRecall:
    """Precision over recall, from the highest score down."""

    recall: Floats  #: (K,) ascending to 1
    precision: Floats  #: (K,)
    thresholds: Floats  #: (K,) descending
    average_precision: float  #: precision averaged over the steps of recall, without interpolation


def sweep(scores: Scores, truth: Bools, thresholds: Floats = PAPER_SWEEP) -> Sweep:
    """Counts of tiles (T,) at each threshold."""
    changed, unchanged = (np.sort(scores[chosen & ~np.isnan(scores)]) for chosen in (truth, ~truth))
    above = [len(part) - np.searchsorted(part, thresholds, side="right") for part in (changed, unchanged)]
    return Sweep(
        thresholds=thresholds,
        true_positives=above[0].astype(np.int64),
        false_positives=above[1].astype(np.int64),
        changed=int(truth.sum()),
        unchanged=int((~truth).sum()),
    )


def all_thresholds(scores: Scores) -> Floats:
    """(K,) ascending: one below every score, then one in each gap, then the highest score; every cut there is."""
    values = np.unique(scores[~np.isnan(scores)]).astype(np.float64)
    if not len(values):
        return np.zeros(1)
    cuts: Floats = np.r_[values[0] - 1e-6, (values[:-1] + values[1:]) / 2, values[-1]]
    return cuts


def best_f1(scores: Scores, truth: Bools, thresholds: Floats | None = PAPER_SWEEP) -> Operating:
    """The threshold with the highest F1 over tiles (T,), the middle one of equals; of every cut if None is given.

    Raises ValueError where nothing changed: every threshold is then as good.
    """
    if not truth.any():
        raise ValueError("a threshold cannot be chosen by F1 where no tile changed")
    found = sweep(scores, truth, all_thresholds(scores) if thresholds is None else thresholds)
    equals = np.flatnonzero(found.f1 >= found.f1.max() - 1e-12)
    threshold = float(found.thresholds[equals[len(equals) // 2]])
    return Operating(threshold=threshold, counts=confusion(scores, truth, threshold))


def roc(scores: Scores, truth: Bools) -> Roc:
    """Over every cut of the tiles (T,); those without a score are never flagged but by "everything"."""
    found = sweep(scores, truth, all_thresholds(scores)[::-1])
    rates = [np.r_[0.0, rate, 1.0] for rate in (found.false_positive_rate, found.recall)]
    return Roc(
        false_positive_rate=rates[0],
        recall=rates[1],
        thresholds=np.r_[np.inf, found.thresholds, -np.inf],
        area=float((np.diff(rates[0]) * (rates[1][1:] + rates[1][:-1]) / 2).sum()),
    )


def precision_recall(scores: Scores, truth: Bools) -> PrecisionRecall:
    """Over every cut of the tiles (T,) that flags something."""
    found = sweep(scores, truth, all_thresholds(scores)[::-1])
    flags = found.true_positives + found.false_positives > 0
    recall, precision = found.recall[flags], found.precision[flags]
    return PrecisionRecall(
        recall=recall,
        precision=precision,
        thresholds=found.thresholds[flags],
        average_precision=float((np.diff(recall, prepend=0.0) * precision).sum()),
    )


def _ratios(part: NDArray[np.int64], whole: NDArray[np.int64] | int) -> Floats:
    total = np.broadcast_to(np.asarray(whole, np.float64), part.shape)
    ratios: Floats = np.divide(part, total, out=np.full(part.shape, np.nan), where=total > 0)
    return ratios
