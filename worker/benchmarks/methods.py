"""The methods that are compared: detectors of the store or of a checkpoint, and what needs no training.

This is the one file of the benchmarks that calls a detector, or opens one.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from worker.benchmarks.baselines import installed_baselines
from worker.benchmarks.plots import Log, read_log
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays
from worker.detectors.comparison import Comparison, side_of
from worker.detectors.detector import Detection, Detector
from worker.detectors.store import detector_class, open_card, open_detector, resolve_device, sha256_of
from worker.errors import DetectorUnavailable
from worker.progress import Progress, no_progress
from worker.training.log import LOG
from worker.training.settings import detector_settings

#: (T,) the higher the more changed; NaN where the tile was not observed
TileScore = NDArray[np.floating[Any]]


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """A way of comparing tiles."""

    name: str
    score: Callable[[TilePairs], TileScore]
    stated: float | None = None  #: the threshold it comes with; None where it has none
    sha256: str | None = None  #: of its weights; None where it has none


def baseline_methods() -> tuple[Method, ...]:
    """Return the baselines that this machine can run."""
    return tuple(Method(name=baseline.name, score=baseline.score) for baseline in installed_baselines())


def detector_methods(model_store: Path, model: str, weights: tuple[Path, ...]) -> tuple[Method, ...]:
    """Return the model with the threshold of its card; or, without one, the checkpoints in its place.

    Raises DetectorUnavailable.
    """
    methods = []
    for path in weights or (None,):
        detector = open_model(model_store, model, path)
        methods.append(
            Method(
                name=model if path is None else "/".join(path.parts[-2:]),
                score=CachedDetector(detector=detector).score,
                stated=detector.card.threshold if path is None else None,
                sha256=detector.card.sha256,
            )
        )
    return tuple(methods)


def open_model(model_store: Path, model: str, weights: Path | None = None) -> Detector:
    """Open a model of the store, or with `weights` the network of a checkpoint of training, under the model's card.

    A checkpoint brings its own patch size and seed, and the sha256 that its weights will have in a model. Raises
    DetectorUnavailable.
    """
    if weights is None:
        return open_detector(model_store, model)
    card = open_card(model_store, model)
    try:
        state = torch.load(weights, map_location="cpu", weights_only=True)
        update = {
            "version": weights.stem,
            "detector_settings": detector_settings(state["settings"]),
            "sha256": sha256_of(state["network"]),
        }
        card = card.model_copy(update=update)
        return detector_class(card.detector).load(card, state["network"], resolve_device("auto"))
    except OSError as missing:
        raise DetectorUnavailable(f"no checkpoint at {weights}: {missing.strerror}") from missing
    except (AttributeError, KeyError, TypeError, EOFError, RuntimeError, pickle.UnpicklingError) as unsound:
        raise DetectorUnavailable(f"{weights} is no checkpoint of spicd-worker train: {unsound}") from unsound


def training_log(model_store: Path, model: str, weights: Path | None) -> Log | None:
    """Read the log that lies beside the model's card, or beside the checkpoint; None where there is none.

    Raises ValueError for a file that is none.
    """
    path = (model_store / model if weights is None else weights.parent) / LOG
    return (read_log(path) or None) if path.exists() else None


def encode_reference(detector: Detector, tiles: Tiles, progress: Progress = no_progress) -> Arrays:
    """Return the reference embedding of the tiles: what the detector keeps with a map."""
    return detector.encode_reference(side_of(tiles), tiles, progress=progress)


def tile_scores(detector: Detector, pairs: TilePairs, embedding: Arrays | None = None) -> Detection:
    """Compare every observed pair; `embedding` is that of the map, if kept."""
    return detector.detect(Comparison.of_tiles(pairs), embedding=embedding)


def change_scores(
    detector: Detector, pairs: TilePairs, embedding: Arrays | None = None
) -> NDArray[np.float32]:
    """Return the probability of change (T,), NaN where not observed."""
    return tile_scores(detector, pairs, embedding).change


@dataclass(kw_only=True, slots=True)
class CachedDetector:
    """A detector on one map after the other: a map is encoded once, and a tile is scored once for each content.

    Most tiles of the paper's experiments are the same points again.
    """

    detector: Detector
    _tiles: Tiles | None = field(default=None, init=False)
    _embedding: Arrays = field(default_factory=dict, init=False)
    _scores: dict[bytes, np.float32] = field(default_factory=dict, init=False)

    def embedding(self, tiles: Tiles) -> Arrays:
        """Return the reference embedding of a map."""
        if self._tiles is None or not _equal(self._tiles, tiles):
            self._tiles, self._embedding, self._scores = tiles, encode_reference(self.detector, tiles), {}
        return self._embedding

    def score(self, pairs: TilePairs) -> NDArray[np.float32]:
        """Return the probability of change (T,), NaN where not observed."""
        embedding = self.embedding(pairs.reference)
        keys = [_key(tile, points.tobytes()) for tile, points in enumerate(pairs.current)]
        new = pairs.observed & [key not in self._scores for key in keys]
        if new.any():
            scores = change_scores(self.detector, replace(pairs, observed=new), embedding)
            self._scores |= {keys[tile]: scores[tile] for tile in np.flatnonzero(new)}
        change = np.full(len(keys), np.nan, np.float32)
        for tile in np.flatnonzero(pairs.observed):
            change[tile] = self._scores[keys[tile]]
        return change


def _key(tile: int, content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=16, person=str(tile).encode()).digest()


def _equal(a: Tiles, b: Tiles) -> bool:
    return a is b or (
        np.array_equal(a.indices, b.indices)
        and all(np.array_equal(one, other) for one, other in zip(a.points, b.points, strict=True))
    )
