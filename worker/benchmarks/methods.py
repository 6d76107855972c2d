"""The methods that are compared: detectors of the store or of a checkpoint, and what needs no training.

This is the one file of the benchmarks that calls a detector, or opens one.
"""

from __future__ import annotations

import hashlib
import pickle  # nosec B403  # for its error alone
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from worker.benchmarks.baselines import installed_baselines, m3c2_is_installed
from worker.benchmarks.plots import Log, read_log
from worker.cloud.tiling import TileChoice, TilePairs, Tiles
from worker.cloud.types import Arrays
from worker.detectors.comparison import Comparison, Side, side_of
from worker.detectors.detector import Detection, Detector
from worker.detectors.store import (
    detector_class,
    open_card,
    open_detector,
    resolve_device,
    sha256_of,
    weights_of,
)
from worker.errors import DetectorUnavailable
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress
from worker.training.log import LOG
from worker.training.settings import detector_settings

#: (T,) the higher the more changed; NaN where the tile was not observed
TileScore = NDArray[np.floating[Any]]


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """A way of comparing tiles that needs no training."""

    name: str
    score: Callable[[TilePairs], TileScore]


def baseline_methods() -> tuple[Method, ...]:
    """Return the baselines that this machine can run."""
    return tuple(Method(name=baseline.name, score=baseline.score) for baseline in installed_baselines())


@dataclass(frozen=True, kw_only=True, slots=True)
class RevisitMethod:
    """A way of comparing two visits, which may look at more than tiles."""

    name: str
    detect: Callable[[Comparison], Detection]
    tiles: TileChoice = "dense"  #: that it scores
    min_points: int = 512  #: of the map in a dense tile
    stated: float | None = None  #: the threshold it comes with; None where it has none
    sha256: str | None = None  #: of its weights; None where it has none
    detector: Detector | None = None  #: what is calibrated on a map's own scans; None for baselines

    @property
    def tells_voxels(self) -> bool:
        """Whether it says what of a tile changed."""
        return self.tiles == "touched"


def revisit_methods(
    model_store: Path,
    model: str,
    weights: tuple[Path, ...],
    pipeline: PipelineSettings,
    *,
    others: bool = True,
) -> tuple[tuple[RevisitMethod, ...], list[str]]:
    """Return the model, or the checkpoints in its place, then with `others` all else; and what is left out, and why.

    All else is the other models of the store that open, and the baselines that this machine can run. Raises
    DetectorUnavailable for the model itself, and where it needs other voxels or tiles than the pipeline makes.
    """
    methods = [
        _of_detector(
            open_model(model_store, model, path),
            model if path is None else "/".join(path.parts[-2:]),
            pipeline,
            stated=path is None,
        )
        for path in weights or (None,)
    ]
    left_out = []
    for name in stored_models(model_store) if others else ():
        if name != model or weights:
            try:
                methods.append(_of_detector(open_model(model_store, name), name, pipeline))
            except DetectorUnavailable as closed:
                left_out.append(str(closed))
    if others:
        methods += [
            RevisitMethod(name=baseline.name, detect=_of_scores(baseline.score))
            for baseline in installed_baselines()
        ]
        if not m3c2_is_installed():
            left_out.append("M3C2: py4dgeo is not installed")
    return tuple(methods), left_out


def ablations(model_store: Path, model: str, pipeline: PipelineSettings) -> tuple[RevisitMethod, ...]:
    """Return a model by voxels without the gate, and without free space: as if nobody knew the sensors' places.

    Raises DetectorUnavailable, and ValueError for a model that knows neither.
    """
    whole = open_model(model_store, model)
    settings = dict(whole.card.detector_settings)
    if whole.card.preprocessing.tiles != "touched":
        raise ValueError(f"model {model} compares tiles by their points: it has no gate and no free space")
    settings["evidence"] = {**settings.get("evidence", {}), "gate": False}
    card = whole.card.model_copy(update={"detector_settings": settings})
    weights = weights_of(whole) if whole.card.weights else {}
    ungated = detector_class(card.detector).load(card, weights, resolve_device("auto"))
    blind = _of_detector(whole, f"{model} without free space", pipeline)
    return (
        replace(blind, detect=lambda comparison: whole.detect(_without_sights(comparison))),
        _of_detector(ungated, f"{model} without the gate", pipeline),
    )


def _without_sights(comparison: Comparison) -> Comparison:
    def blinded(side: Side) -> Side:
        return side if side.seen is None else replace(side, seen=replace(side.seen, sights=None))

    return replace(comparison, reference=blinded(comparison.reference), current=blinded(comparison.current))


def stored_models(model_store: Path) -> tuple[str, ...]:
    """List the models of a store, as in `spicd-net/1`."""
    cards = sorted(model_store.glob("*/*/card.json"))
    return tuple("/".join(card.parts[-3:-1]) for card in cards)


def _of_detector(
    detector: Detector, name: str, pipeline: PipelineSettings, *, stated: bool = True
) -> RevisitMethod:
    card, needs = detector.card, detector.card.preprocessing
    made = pipeline.registration.voxel_size, pipeline.tiling.tile_size
    if (needs.voxel_size, needs.tile_size) != made:
        raise DetectorUnavailable(
            f"model {name} needs voxels of {needs.voxel_size} m and tiles of {needs.tile_size}, "
            f"and the visits have {made[0]} and {made[1]}"
        )
    touched = needs.tiles == "touched"
    return RevisitMethod(
        name=name,
        detect=detector.detect if touched else _of_scores(CachedDetector(detector=detector).score),
        tiles=needs.tiles,
        min_points=needs.min_points,
        stated=card.threshold if stated else None,
        sha256=card.sha256,
        detector=detector,
    )


def _of_scores(score: Callable[[TilePairs], TileScore]) -> Callable[[Comparison], Detection]:
    """Make a detection of one score a tile."""

    def detect(comparison: Comparison) -> Detection:
        return Detection.of_scores(score(comparison.tile_pairs))

    return detect


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


def tile_scores(detector: Detector, comparison: Comparison, embedding: Arrays | None = None) -> Detection:
    """Compare every observed pair; `embedding` is that of the map, if kept."""
    return detector.detect(comparison, embedding=embedding)


def change_scores(
    detector: Detector, pairs: TilePairs, embedding: Arrays | None = None
) -> NDArray[np.float32]:
    """Return the probability of change (T,), NaN where not observed."""
    return tile_scores(detector, Comparison.of_tiles(pairs), embedding).change


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
