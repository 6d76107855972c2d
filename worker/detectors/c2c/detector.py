"""C2C as a detector: how far the two clouds are apart in each tile, as a score between 0 and 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from worker.cloud.settings import StrictModel
from worker.cloud.tiling import Tiles
from worker.cloud.types import Arrays, Floats, Points
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.progress import Progress, no_progress
from worker.threads import query_threads

FARTHEST = 1.0  #: metres; no nearest distance counts as more, and none is searched beyond


class CloudToCloudSettings(StrictModel):
    """`detector_settings` of a card of this detector."""

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


def distances_both_ways(
    comparison: Comparison, *, farthest: float = FARTHEST
) -> tuple[list[Floats], list[Floats]]:
    """Return of each of T tiles the (n,) metres from the survey's points to the map, and from the map's to the survey.

    Neighbours are looked for in the whole other cloud, so that the border of a tile is no change.
    """
    pairs = comparison.tile_pairs
    return (
        nearest_distances(pairs.current, comparison.reference.points, farthest=farthest),
        nearest_distances(pairs.reference.points, comparison.current.points, farthest=farthest),
    )


def nearest_distances(tiles: Sequence[Points], cloud: Points, *, farthest: float = FARTHEST) -> list[Floats]:
    """Return of each tile (n, 3) the (n,) metres to the nearest point of the cloud (M, 3), at most `farthest`."""
    if not len(cloud) or not tiles:
        return [np.full(len(part), farthest) for part in tiles]
    distance, _ = cKDTree(cloud).query(
        np.concatenate(tiles), distance_upper_bound=farthest, workers=query_threads()
    )
    return split_by_tile(np.minimum(distance, farthest), tiles)


def split_by_tile(values: Floats, tiles: Sequence[Points]) -> list[Floats]:
    """Part the values (N,) of all tiles' points, end to end, into one array a tile."""
    return list(np.split(values, np.cumsum([len(part) for part in tiles])[:-1]))


def tile_means(parts: Sequence[Floats]) -> Floats:
    """Return the mean of each tile's values, (T,); NaN for a tile without points."""
    return np.array([part.mean() if len(part) else np.nan for part in parts])
