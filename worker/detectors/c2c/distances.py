"""Nearest distances between two clouds, tile by tile."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from worker.cloud.types import Floats, Points
from worker.detectors.comparison import Comparison
from worker.threads import query_threads

FARTHEST = 1.0  #: metres; no nearest distance counts as more, and none is searched beyond


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
