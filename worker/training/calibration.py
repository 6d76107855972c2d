"""Choosing the threshold (paper, Section 3.9.3), on pairs as a survey makes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Points
from worker.metrics import confusion, roc
from worker.training.anomalies import OPERATIONS
from worker.training.dataset import TileSet
from worker.training.pairs import PairSettings, changed

#: Share of changed tiles that the threshold is chosen for: of the simulated revisits 4% changed. The paper's
#: experiments change 24 of 172, but nobody patrols a building of which a seventh changes between two rounds.
PREVALENCE = 0.05
SWEEP = np.round(np.arange(0.02, 0.99, 0.01), 2)
UNCHANGED, WHOLE = "unchanged", "whole"


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyPairs:
    """Dense tiles of two visits, unchanged, with a synthetic change, or after whole things came, went or moved.

    Nothing is augmented.
    """

    reference: tuple[Points, ...]  #: P arrays (n, 3), metres, tile-centre frame
    current: tuple[Points, ...]
    kinds: tuple[str, ...]  #: "unchanged", the operation that changed the current tile, or "whole"

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(P,)"""
        return np.array([kind != UNCHANGED for kind in self.kinds])

    @property
    def decisive(self) -> NDArray[np.bool_]:
        """(P,) pairs that a threshold is chosen by: unchanged, and whole things where there are any."""
        kinds = np.array(self.kinds)
        return (kinds == UNCHANGED) | (kinds == WHOLE) if WHOLE in self.kinds else np.ones(len(kinds), bool)

    def subset(self, chosen: NDArray[np.intp]) -> SurveyPairs:
        """Return the pairs at these indices."""
        return SurveyPairs(
            reference=tuple(self.reference[pair] for pair in chosen),
            current=tuple(self.current[pair] for pair in chosen),
            kinds=tuple(self.kinds[pair] for pair in chosen),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class SurveyFigures:
    """How a threshold does; precision and F1 are for PREVALENCE, whatever the set's own share is."""

    threshold: float
    precision: float
    recall: float
    f1: float
    false_positive_rate: float
    recall_by_kind: dict[str, float]


def survey_pairs(tiles: TileSet, settings: PairSettings, *, seed: int) -> SurveyPairs:
    """Pair both ways round every tile of two visits, unchanged and changed, and every observation of another visit."""
    rng = np.random.default_rng((seed, 3))
    reference: list[Points] = []
    current: list[Points] = []
    kinds: list[str] = []
    for a, b in zip(tiles.points_a, tiles.points_b, strict=True):
        if len(b) == 0:
            continue
        for first, second in ((a, b), (b, a)):
            for kind in (UNCHANGED, *OPERATIONS):
                operation = OPERATIONS.get(kind)
                after = (
                    changed(second, settings, tiles.half, rng, operation=operation) if operation else second
                )
                reference.append(first)
                current.append(after)
                kinds.append(kind)
    for observation in tiles.observations:
        if not observation.rebuilt:
            a = tiles.points_a[observation.tile]
            reference += [a, observation.points]
            current += [observation.points, a]
            kinds += 2 * [WHOLE if observation.changed else UNCHANGED]
    return SurveyPairs(reference=tuple(reference), current=tuple(current), kinds=tuple(kinds))


def best_threshold(scores: NDArray[np.float32], pairs: SurveyPairs) -> SurveyFigures:
    """Return the threshold with the highest F1; the middle one of equals."""
    every = [figures_at(float(threshold), scores, pairs) for threshold in SWEEP]
    best = max(point.f1 for point in every)
    equals = [point for point in every if point.f1 >= best - 1e-9]
    return equals[len(equals) // 2]


def figures_at(threshold: float, scores: NDArray[np.float32], pairs: SurveyPairs) -> SurveyFigures:
    """Return what `scores` (P,), the probability of change, reach above a threshold.

    Recall is of the pairs that the threshold is chosen by.
    """
    kinds, changed = np.array(pairs.kinds), pairs.changed
    counts = confusion(scores, changed, threshold, observed=pairs.decisive | ~changed)
    precision, recall = counts.precision_at(PREVALENCE), counts.recall
    return SurveyFigures(
        threshold=threshold,
        precision=precision,
        recall=recall,
        f1=2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
        false_positive_rate=counts.false_positive_rate,
        recall_by_kind={
            kind: float((scores > threshold)[kinds == kind].mean())
            for kind in (*OPERATIONS, WHOLE)
            if (kinds == kind).any()
        },
    )


def area_under_roc(scores: NDArray[np.float32], pairs: SurveyPairs) -> float:
    """Return the chance that a changed pair scores above an unchanged one; `pairs.decisive` alone count."""
    return roc(scores[pairs.decisive], pairs.changed[pairs.decisive]).area
