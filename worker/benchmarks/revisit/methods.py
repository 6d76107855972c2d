"""The methods that are compared: every one gives each tile a score that grows with change."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.benchmarks.paper.measured import open_measured
from worker.benchmarks.revisit.record import Revisit
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detector
from worker.detectors.store import open_detector
from worker.progress import Progress, no_progress

TileScore = NDArray[np.floating[Any]]  #: (T,), NaN where the tile was not observed


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """A way of comparing tiles."""

    name: str
    score: Callable[[TilePairs], TileScore]
    stated: float | None = None  #: the threshold it comes with; None where it has none
    sha256: str | None = None  #: of its weights; None where it has none


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Scored:
    """What a method said of some visits."""

    scores: tuple[TileScore, ...]  #: one array a visit
    seconds: float  #: for all of them

    @property
    def together(self) -> TileScore:
        """(N,) of all tiles, visit after visit."""
        return np.concatenate(self.scores)


def score_visits(method: Method, visits: Sequence[Revisit], progress: Progress = no_progress) -> Scored:
    """Every visit by itself, against the clock."""
    scores, begun = [], time.perf_counter()
    for done, revisit in enumerate(visits):
        progress(f"scoring: {method.name}", done / len(visits))
        scores.append(method.score(revisit.pairs))
    return Scored(scores=tuple(scores), seconds=time.perf_counter() - begun)


@dataclass(kw_only=True, slots=True)
class DetectorScore:
    """A detector's probability of change; what it says of a map alone is kept for the next visit to it."""

    detector: Detector
    _tiles: Tiles | None = None
    _embedding: Arrays = field(default_factory=dict)

    def __call__(self, pairs: TilePairs) -> TileScore:
        comparison = Comparison.of_tiles(pairs)
        if self._tiles is None or not _equal(self._tiles, pairs.reference):
            self._tiles, self._embedding = (
                pairs.reference,
                self.detector.encode_reference(comparison.reference, pairs.reference),
            )
        return self.detector.detect(comparison, embedding=self._embedding).change


def opened(model_store: Path, model: str) -> Method:
    """A model of the store, with the threshold of its card. Raises DetectorUnavailable."""
    detector = open_detector(model_store, model)
    card = detector.card
    return Method(
        name=model, score=DetectorScore(detector=detector), stated=card.threshold, sha256=card.sha256
    )


def from_checkpoint(path: Path, model_store: Path, model: str) -> Method:
    """SPICD-Net with the weights of a checkpoint of `spicd-worker train`; what else it needs is on the model's card.

    Raises DetectorUnavailable where the file is no such checkpoint, or there is none.
    """
    detector = open_measured(model_store, model, path)
    return Method(
        name="/".join(path.parts[-2:]), score=DetectorScore(detector=detector), sha256=detector.card.sha256
    )


def _equal(a: Tiles, b: Tiles) -> bool:
    return np.array_equal(a.indices, b.indices) and all(
        np.array_equal(one, other) for one, other in zip(a.points, b.points, strict=True)
    )
