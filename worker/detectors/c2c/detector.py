"""C2C as a detector: how far the two clouds are apart in each tile, as a score between 0 and 1."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from worker.cloud.tiling import Tiles
from worker.cloud.types import Arrays, Floats
from worker.detectors.c2c.distances import FARTHEST, distances_both_ways, tile_means
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.progress import Progress, no_progress


class CloudToCloudSettings(BaseModel):
    """`detector_settings` of a card of this detector."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    half_distance: float = Field(gt=0, description="metres; a tile that far apart has the score 0.5")
    max_distance: float = Field(FARTHEST, gt=0, description="metres; no nearest distance counts as more")


class CloudToCloud:
    """Detector (worker.detectors.detector) by the mean nearest distance d of a tile's points, metres.

    Of the two directions the larger counts, so that what was added and what was removed weigh alike. The score is
    d / (d + half_distance): it grows with d, and a score s stands for half_distance * s / (1 - s) metres.
    """

    settings_class = CloudToCloudSettings

    def __init__(self, card: Card) -> None:
        self.card = card
        self._settings = card.settings_as(CloudToCloudSettings)

    @classmethod
    def load(cls, card: Card, weights: Mapping[str, object], device: object) -> CloudToCloud:  # noqa: ARG003
        """Open a model; it has no weights and runs on the CPU. Raises ValueError for unsound settings."""
        return cls(card)

    def encode_reference(
        self,
        reference: Side,  # noqa: ARG002
        tiles: Tiles,  # noqa: ARG002
        *,
        progress: Progress = no_progress,
    ) -> Arrays:
        """Return nothing: a tree over the map takes less time than reading one would."""
        progress("encoding", 1.0)
        return {}

    def detect(
        self,
        comparison: Comparison,
        *,
        embedding: Arrays | None = None,  # noqa: ARG002
        progress: Progress = no_progress,
    ) -> Detection:
        """Score every observed tile; rows of the others are NaN."""
        progress("scoring", 0.0)
        distance = tile_distances(comparison, farthest=self._settings.max_distance)
        distance[~comparison.observed] = np.nan
        progress("scoring", 1.0)
        return Detection.of_scores(distance / (distance + self._settings.half_distance))


def tile_distances(comparison: Comparison, *, farthest: float = FARTHEST) -> Floats:
    """Return the mean nearest distance of each tile, the larger of both directions: (T,) metres, NaN for no point."""
    there, back = distances_both_ways(comparison, farthest=farthest)
    larger: Floats = np.fmax(tile_means(there), tile_means(back))
    return larger
