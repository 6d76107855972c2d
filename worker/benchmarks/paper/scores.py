"""What the methods said of every trial, and where the detector's pairs lie in its own space (paper, Section 5.9)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.methods import (
    CachedDetector,
    Method,
    TileScore,
    change_scores,
    encode_reference,
    tile_scores,
)
from worker.benchmarks.paper.experiments import Trial
from worker.cloud.tiling import Tiles
from worker.cloud.types import Bools, Floats
from worker.detectors.detector import Detector

UNCHANGED_A_TRIAL = 15  #: of the many that are rightly left alone; the others are drawn all
SEED = 42


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MethodScores:
    """What one method said of every trial."""

    name: str
    scores: tuple[Floats, ...]  #: of each trial, (T,)
    truths: tuple[Bools, ...]  #: likewise
    seconds: float  #: to score a whole map

    @property
    def pooled(self) -> Floats:
        """Of all trials together, (sum of T,)"""
        return np.concatenate(self.scores)

    @property
    def truth(self) -> Bools:
        """Of all trials together, (sum of T,)"""
        return np.concatenate(self.truths)


def scored_by_detector(name: str, cached: CachedDetector, trials: Sequence[Trial]) -> MethodScores:
    """Score every trial by the detector; its seconds are those of one map scored as a survey does it.

    Nothing is kept for that but the reference embedding. A detector by voxels is given what the scans saw.
    """
    if trials[0].seen is not None:
        return _scored_by_voxels(name, cached.detector, trials)
    pairs = trials[0].pairs
    embedding = cached.embedding(pairs.reference)
    begun = time.perf_counter()
    change_scores(cached.detector, pairs, embedding)
    seconds = time.perf_counter() - begun
    return _method_scores(name, [cached.score(trial.pairs) for trial in trials], trials, seconds)


def _scored_by_voxels(name: str, detector: Detector, trials: Sequence[Trial]) -> MethodScores:
    scores, seconds = [], []
    for trial in trials:
        begun = time.perf_counter()
        scores.append(tile_scores(detector, trial.comparison).change)
        seconds.append(time.perf_counter() - begun)
    return _method_scores(name, scores, trials, float(np.median(seconds)))


def scored_by_baseline(baseline: Method, trials: Sequence[Trial]) -> MethodScores:
    """Score every trial by a baseline; its seconds are the median."""
    scores, seconds = [], []
    for trial in trials:
        begun = time.perf_counter()
        scores.append(baseline.score(trial.pairs))
        seconds.append(time.perf_counter() - begun)
    return _method_scores(baseline.name, scores, trials, float(np.median(seconds)))


def _method_scores(
    name: str, scores: Sequence[TileScore], trials: Sequence[Trial], seconds: float
) -> MethodScores:
    return MethodScores(
        name=name,
        scores=tuple(part.astype(np.float64) for part in scores),
        truths=tuple(trial.truth for trial in trials),
        seconds=seconds,
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Embedding:
    """Fused feature vectors |f_ref - f_cur|, f_ref * f_cur, projected on their two main directions."""

    places: Floats  #: (P, 2)
    explained: tuple[float, float]  #: share of the variance along each
    outcomes: NDArray[np.str_]  #: (P,) TP, FP, FN or TN


def embed(
    cached: CachedDetector, trials: Sequence[Trial], method: MethodScores, threshold: float
) -> Embedding | None:
    """Project all pairs that are changed or flagged, and some others; None for a detector without descriptors."""
    known = cached.embedding(trials[0].pairs.reference).get("descriptors")
    if known is None:
        return None
    rng = np.random.default_rng(SEED)
    vectors, outcomes = [], []
    for trial, score in zip(trials, method.scores, strict=True):
        outcome = outcomes_of(score, trial.truth, threshold)
        chosen = _chosen(outcome, trial.pairs.observed, rng)
        if not len(chosen):
            continue
        pair = trial.pairs.subset(chosen)
        current = Tiles(grid=pair.reference.grid, indices=pair.reference.indices, points=pair.current)
        reference, now = known[chosen], encode_reference(cached.detector, current)["descriptors"]
        vectors.append(np.hstack([np.abs(reference - now), reference * now]))
        outcomes.append(outcome[chosen])
    places, explained = principal(np.concatenate(vectors))
    return Embedding(places=places, explained=explained, outcomes=np.concatenate(outcomes))


def outcomes_of(scores: Floats, truth: NDArray[np.bool_], threshold: float) -> NDArray[np.str_]:
    """Name what became of each tile: (T,) TP, FP, FN or TN."""
    flagged = scores > threshold
    return np.where(flagged, np.where(truth, "TP", "FP"), np.where(truth, "FN", "TN"))


def principal(vectors: NDArray[np.floating]) -> tuple[Floats, tuple[float, float]]:
    """Project vectors (P, C) on the two directions of most variance: (P, 2), and the share of each."""
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
