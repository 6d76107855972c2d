"""A detector that is entered in the table of detectors, with settings of its own and scores of voxels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel, ConfigDict

from worker.cloud.tiling import Tiles
from worker.cloud.types import Arrays
from worker.detectors import registry, store
from worker.detectors.card import Card, Preprocessing
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection, VoxelScores
from worker.progress import Progress, no_progress

MODEL = "toy/1"


class ToySettings(BaseModel):
    """What the toy's card says."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    gain: float


class Toy:
    """Calls a tile changed as much as its number of points is another than that which it kept of the map.

    It also loads every scan, asks where each was taken from, and says something of two voxels.
    """

    settings_class = ToySettings

    def __init__(self, card: Card) -> None:
        self.card = card
        self.gain = card.settings_as(ToySettings).gain
        self.origins: list[Any] = []

    @classmethod
    def load(cls, card: Card, weights: Any, device: Any) -> Toy:
        return cls(card)

    def encode_reference(self, reference: Side, tiles: Tiles, *, progress: Progress = no_progress) -> Arrays:
        progress("encoding", 1.0)
        return {"counts": np.array([len(points) for points in tiles.points])}

    def detect(
        self, comparison: Comparison, *, embedding: Arrays | None = None, progress: Progress = no_progress
    ) -> Detection:
        tiles = comparison.tile_pairs.reference
        kept = embedding or self.encode_reference(comparison.reference, tiles, progress=progress)
        for side in (comparison.reference, comparison.current):
            self.origins += [load().sensor_origin for load in side.scans]
        now = np.array([len(points) for points in comparison.tile_pairs.current])
        share = np.clip(self.gain * np.abs(now - kept["counts"]) / kept["counts"], 0, 1)
        progress("scoring", 1.0)
        detection = Detection.of_scores(np.where(comparison.observed, share, np.nan))
        voxels = VoxelScores(
            keys=np.array([3, 5]),
            appeared=np.ones(2, "f4"),
            disappeared=np.zeros(2, "f4"),
            judged=np.ones(2, bool),
            moving=np.zeros(2, bool),
            seen_through=np.ones(2, np.int16),
        )
        return Detection(probabilities=detection.probabilities, voxels=voxels)


def install(patch: pytest.MonkeyPatch, model_store: Path) -> Card:
    """Register the toy, and put its card into a store."""
    card = Card(
        name="toy",
        version="1",
        detector="toy",
        summary="for tests",
        threshold=0.25,
        preprocessing=Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512),
        detector_settings={"gain": 0.5},
    )
    patch.setitem(registry.DETECTORS, "toy", registry.Entry(detector=f"{__name__}:Toy"))
    folder = model_store / MODEL
    folder.mkdir(parents=True)
    store.write_card(folder, card)
    return card
