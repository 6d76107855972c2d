"""Counts of tiles or pairs right and wrong, and the ratios made of them (paper, Section 4.3).

A tile is flagged where its score is above the threshold (Section 3.9.4). A tile without a score (NaN) is never
flagged: nobody was told of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Bools, Floats

Scores = NDArray[np.floating[Any]]
RATIOS = ("precision", "recall", "f1", "accuracy", "false_positive_rate")  #: of a Confusion


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
        ours, theirs = asdict(self), asdict(other)
        return Confusion(**{name: count + theirs[name] for name, count in ours.items()})

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

    def precision_at(self, prevalence: float) -> float:
        """Return the precision where such a share (0..1) of the tiles changed, at the same recall and false alarms."""
        hits, alarms = prevalence * self.recall, (1 - prevalence) * self.false_positive_rate
        return hits / (hits + alarms) if hits + alarms > 0 else 0.0

    def figures(self) -> dict[str, float | int | None]:
        """Return all of the above, JSON-ready: None where a ratio has no meaning."""
        ratios = {name: getattr(self, name) for name in RATIOS}
        return asdict(self) | {
            name: None if np.isnan(value) else round(value, 4) for name, value in ratios.items()
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
    """Return all counts added up, so that figures are micro-aggregated (paper, Table 5, last row)."""
    return sum(counts, Confusion())


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


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
    """Count tiles (T,) at each threshold."""
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
    """Return every cut there is, (K,) ascending: below every score, in each gap, at the highest score."""
    values = np.unique(scores[~np.isnan(scores)]).astype(np.float64)
    if not len(values):
        return np.zeros(1)
    cuts: Floats = np.r_[values[0] - 1e-6, (values[:-1] + values[1:]) / 2, values[-1]]
    return cuts


def best_f1(scores: Scores, truth: Bools, thresholds: Floats | None = PAPER_SWEEP) -> Operating:
    """Return the threshold with the highest F1 over tiles (T,), the middle of equals; of every cut if None is given.

    Raises ValueError where nothing changed: every threshold is then as good.
    """
    if not truth.any():
        raise ValueError("a threshold cannot be chosen by F1 where no tile changed")
    swept = sweep(scores, truth, all_thresholds(scores) if thresholds is None else thresholds)
    equals = np.flatnonzero(swept.f1 >= swept.f1.max() - 1e-12)
    threshold = float(swept.thresholds[equals[len(equals) // 2]])
    return Operating(threshold=threshold, counts=confusion(scores, truth, threshold))


def roc(scores: Scores, truth: Bools) -> Roc:
    """Return the curve over every cut of the tiles (T,); only "everything" flags those without a score."""
    swept = sweep(scores, truth, all_thresholds(scores)[::-1])
    rates = [np.r_[0.0, rate, 1.0] for rate in (swept.false_positive_rate, swept.recall)]
    return Roc(
        false_positive_rate=rates[0],
        recall=rates[1],
        thresholds=np.r_[np.inf, swept.thresholds, -np.inf],
        area=float((np.diff(rates[0]) * (rates[1][1:] + rates[1][:-1]) / 2).sum()),
    )


def precision_recall(scores: Scores, truth: Bools) -> PrecisionRecall:
    """Return the curve over every cut of the tiles (T,) that flags something."""
    swept = sweep(scores, truth, all_thresholds(scores)[::-1])
    flags = swept.true_positives + swept.false_positives > 0
    recall, precision = swept.recall[flags], swept.precision[flags]
    return PrecisionRecall(
        recall=recall,
        precision=precision,
        thresholds=swept.thresholds[flags],
        average_precision=float((np.diff(recall, prepend=0.0) * precision).sum()),
    )


def _ratios(part: NDArray[np.int64], whole: NDArray[np.int64] | int) -> Floats:
    total = np.broadcast_to(np.asarray(whole, np.float64), part.shape)
    ratios: Floats = np.divide(part, total, out=np.full(part.shape, np.nan), where=total > 0)
    return ratios


@dataclass(frozen=True, kw_only=True, slots=True)
class ClassFigures:
    """How a classifier of pairs does on three classes."""

    loss: float
    accuracy: float
    precision: tuple[float, float, float]  #: of each class; 0 for a class never answered
    recall: tuple[float, float, float]

    @property
    def rank(self) -> tuple[float, float]:
        """Which checkpoint is better: accuracy, then the worst class's precision (paper, Section 3.8)."""
        return self.accuracy, min(self.precision)


def class_figures(probabilities: NDArray[np.float32], labels: NDArray[np.int64], loss: float) -> ClassFigures:
    """Count the answers (n, 3) beside the labels (n,)."""
    answers = np.zeros((3, 3), dtype=np.int64)  # true class, answered class
    np.add.at(answers, (labels, probabilities.argmax(axis=1)), 1)
    hits = np.diag(answers)
    precision = (hits / np.maximum(answers.sum(axis=0), 1)).tolist()
    recall = (hits / np.maximum(answers.sum(axis=1), 1)).tolist()
    return ClassFigures(
        loss=loss,
        accuracy=float(hits.sum() / max(len(labels), 1)),
        precision=(precision[0], precision[1], precision[2]),
        recall=(recall[0], recall[1], recall[2]),
    )
