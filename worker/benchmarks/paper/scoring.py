"""The methods that are compared, each scoring the tiles of every trial."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.baselines import Baseline
from worker.benchmarks.paper.trial import Trial
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays, Bools, Floats
from worker.detectors.comparison import Comparison, side_of
from worker.detectors.detector import Detector


@dataclass(kw_only=True, slots=True)
class CachedDetector:
    """A detector on one map: the reference is encoded once, and a tile is scored once for each content.

    Most tiles of the experiments are the same points again.
    """

    detector: Detector
    tiles: Tiles
    _embedding: Arrays | None = field(default=None, init=False)
    _known: dict[bytes, NDArray[np.float32]] = field(default_factory=dict, init=False)

    @property
    def embedding(self) -> Arrays:
        """Of the reference."""
        if self._embedding is None:
            self._embedding = self.detector.encode_reference(side_of(self.tiles), self.tiles)
        return self._embedding

    def score(self, pairs: TilePairs) -> NDArray[np.float32]:
        """(T,) probability of change; NaN where not observed. The pairs must be of this map."""
        keys = [_key(tile, points.tobytes()) for tile, points in enumerate(pairs.current)]
        new = np.array(
            [tile for tile in np.flatnonzero(pairs.observed) if keys[tile] not in self._known], int
        )
        if len(new):
            part = selected(pairs, new)
            known = {name: values[new] for name, values in self.embedding.items()}
            found = self.detector.detect(Comparison.of_tiles(part), embedding=known)
            self._known |= {keys[tile]: row for tile, row in zip(new, found.change, strict=True)}
        nothing = np.float32(np.nan)
        return np.array(
            [self._known[key] if seen else nothing for key, seen in zip(keys, pairs.observed, strict=True)],
            np.float32,
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MethodScores:
    """What one method said of every trial."""

    name: str
    scores: tuple[Floats, ...]  #: of each trial, (T,)
    truths: tuple[Bools, ...]  #: likewise
    seconds: float  #: to score a whole map

    @property
    def pooled(self) -> Floats:
        """(sum of T,)"""
        return np.concatenate(self.scores)

    @property
    def truth(self) -> Bools:
        """(sum of T,)"""
        return np.concatenate(self.truths)


def scored(
    name: str, score: Callable[[TilePairs], Floats], given: Sequence[Trial], seconds: float
) -> MethodScores:
    """Every trial by one method whose seconds are known."""
    return MethodScores(
        name=name,
        scores=tuple(score(trial.pairs).astype(np.float64) for trial in given),
        truths=tuple(trial.truth for trial in given),
        seconds=seconds,
    )


def scored_by_detector(name: str, cached: CachedDetector, given: Sequence[Trial]) -> MethodScores:
    """Every trial by the detector, and the seconds of one map scored as a survey does it, nothing kept but the reference."""
    known = cached.embedding
    begun = time.perf_counter()
    cached.detector.detect(Comparison.of_tiles(given[0].pairs), embedding=known)
    seconds = time.perf_counter() - begun
    return scored(name, lambda pairs: cached.score(pairs).astype(np.float64), given, seconds)


def scored_by_baseline(baseline: Baseline, given: Sequence[Trial]) -> MethodScores:
    """Every trial by a baseline, and its median seconds."""
    seconds: list[float] = []

    def timed(pairs: TilePairs) -> Floats:
        begun = time.perf_counter()
        found = baseline.score(pairs)
        seconds.append(time.perf_counter() - begun)
        return found

    found = scored(baseline.name, timed, given, 0.0)
    return MethodScores(
        name=found.name, scores=found.scores, truths=found.truths, seconds=float(np.median(seconds))
    )


def selected(pairs: TilePairs, chosen: NDArray[np.intp]) -> TilePairs:
    """The pairs at these places (t,) alone."""
    reference = Tiles(
        grid=pairs.reference.grid,
        indices=pairs.reference.indices[chosen],
        points=tuple(pairs.reference.points[tile] for tile in chosen),
    )
    current = tuple(pairs.current[tile] for tile in chosen)
    return TilePairs(reference=reference, current=current, observed=pairs.observed[chosen])


def _key(tile: int, content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=16, person=str(tile).encode()).digest()
