"""Where pairs lie in the network's own space (paper, Section 5.9 and Figure 12)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.paper.scoring import CachedDetector, MethodScores, selected
from worker.benchmarks.paper.trial import Trial
from worker.cloud.tiling import Tiles
from worker.cloud.types import Floats
from worker.detectors.comparison import side_of

UNCHANGED_A_TRIAL = 15  #: of the many that are rightly left alone; the others are drawn all
SEED = 42


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Embedding:
    """Fused feature vectors |f_ref - f_cur|, f_ref * f_cur, projected on their two main directions."""

    places: Floats  #: (P, 2)
    explained: tuple[float, float]  #: share of the variance along each
    outcomes: NDArray[np.str_]  #: (P,) TP, FP, FN or TN
    distances: Floats  #: (P,) between both descriptors
    scores: Floats  #: (P,)


def embed(
    cached: CachedDetector, given: Sequence[Trial], found: MethodScores, threshold: float
) -> Embedding | None:
    """Of all pairs that are changed or flagged, and some others; None for a detector without descriptors."""
    known = cached.embedding.get("descriptors")
    if known is None:
        return None
    rng = np.random.default_rng(SEED)
    vectors, outcomes, distances, scores = [], [], [], []
    for trial, score in zip(given, found.scores, strict=True):
        outcome = outcomes_of(score, trial.truth, threshold)
        chosen = _chosen(outcome, trial.pairs.observed, rng)
        if not len(chosen):
            continue
        pair = selected(trial.pairs, chosen)
        current = Tiles(grid=pair.reference.grid, indices=pair.reference.indices, points=pair.current)
        reference, now = (
            known[chosen],
            cached.detector.encode_reference(side_of(current), current)["descriptors"],
        )
        vectors.append(np.hstack([np.abs(reference - now), reference * now]))
        distances.append(np.linalg.norm(reference - now, axis=1))
        outcomes.append(outcome[chosen])
        scores.append(score[chosen])
    places, explained = principal(np.concatenate(vectors))
    return Embedding(
        places=places,
        explained=explained,
        outcomes=np.concatenate(outcomes),
        distances=np.concatenate(distances),
        scores=np.concatenate(scores),
    )


def outcomes_of(scores: Floats, truth: NDArray[np.bool_], threshold: float) -> NDArray[np.str_]:
    """(T,) TP, FP, FN or TN."""
    flagged = scores > threshold
    return np.where(flagged, np.where(truth, "TP", "FP"), np.where(truth, "FN", "TN"))


def principal(vectors: NDArray[np.floating]) -> tuple[Floats, tuple[float, float]]:
    """(P, C) -> (P, 2), along the two directions of most variance, and the share of each."""
    centred = vectors.astype(np.float64) - vectors.mean(axis=0)
    left, lengths, _ = np.linalg.svd(centred, full_matrices=False)
    shares = lengths**2 / max(float((lengths**2).sum()), 1e-30)
    return left[:, :2] * lengths[:2], (float(shares[0]), float(shares[1]))


def _chosen(
    outcome: NDArray[np.str_], observed: NDArray[np.bool_], rng: np.random.Generator
) -> NDArray[np.intp]:
    quiet = np.flatnonzero((outcome == "TN") & observed)
    some = rng.choice(quiet, min(UNCHANGED_A_TRIAL, len(quiet)), replace=False)
    return np.sort(np.concatenate([np.flatnonzero((outcome != "TN") & observed), some]))
