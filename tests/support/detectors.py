"""A detector that counts points and what it was asked: handed to the benchmarks as it is, in no table of detectors."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel

from worker.cloud.tiling import Tiles
from worker.cloud.types import Arrays
from worker.detectors.card import Card, Preprocessing
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.progress import Progress, no_progress


class NoSettings(BaseModel):
    """The card says nothing beyond what every card does."""


class CountingDetector:
    """Says how much the number of points changed, and keeps count of the tiles it was asked about."""

    card = Card(
        name="counting",
        version="1",
        detector="counting",
        summary="",
        threshold=0.0,
        preprocessing=Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512),
    )

    settings_class = NoSettings

    @classmethod
    def load(cls, card: Card, weights: Any, device: Any) -> CountingDetector:
        return cls()

    def __init__(self) -> None:
        self.encoded = 0
        self.asked: list[int] = []

    def encode_reference(self, reference: Side, tiles: Tiles, *, progress: Progress = no_progress) -> Arrays:
        self.encoded += 1
        return {"counts": np.array([len(points) for points in tiles.points])}

    def detect(
        self, comparison: Comparison, *, embedding: Arrays | None = None, progress: Progress = no_progress
    ) -> Detection:
        pairs = comparison.tile_pairs
        known = (
            self.encode_reference(comparison.reference, pairs.reference) if embedding is None else embedding
        )
        assert len(known["counts"]) == len(pairs.current)
        self.asked.append(int(pairs.observed.sum()))
        now = np.array([len(points) for points in pairs.current])
        share = np.abs(now - known["counts"]) / known["counts"]
        probabilities = np.stack([1 - share, share, 0 * share], axis=1).astype(np.float32)
        probabilities[~pairs.observed] = np.nan
        return Detection(probabilities=probabilities)
