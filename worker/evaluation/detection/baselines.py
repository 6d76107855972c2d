"""What users would do without a network: distances between the two clouds, one score a tile, no training.

Distances are taken between the whole clouds, not tile by tile, so that the border of a tile is no change. A
tile that was not observed gets NaN. Scores are in metres or shares; each has a threshold of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from scipy.spatial import cKDTree

from worker.pipeline.normals import estimate_normals
from worker.pipeline.tiling import TilePairs, Tiles
from worker.pipeline.values import Floats, Normals, Points
from worker.threads import query_threads

FARTHEST = 1.0  #: metres; no nearest distance counts as more, and none is searched beyond
FAR = 0.10  #: metres; two voxels of the fused maps
NORMAL_RADIUS, NORMAL_NEIGHBORS = 0.15, 30  #: metres; of the plane that M3C2-approx puts through a point


class Baseline(Protocol):
    """A method that needs no training."""

    @property
    def name(self) -> str:
        """As tables call it."""
        ...

    def score(self, pairs: TilePairs) -> Floats:
        """(T,) the higher the more changed; NaN where the tile was not observed."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class CloudToCloud:
    """C2C: nearest distances both ways (Girardeau-Montaut et al. 2005, the paper's [7]).

    `mean` is their mean over the tile's points in metres, `far` the share of points over 10 cm; of the two
    directions the larger counts, so that what was added and what was removed weigh alike.
    """

    statistic: Literal["mean", "far"] = "mean"

    @property
    def name(self) -> str:
        return {"mean": "C2C (mean)", "far": "C2C (share over 10 cm)"}[self.statistic]

    def score(self, pairs: TilePairs) -> Floats:
        reference, current = pairs.reference.points, pairs.current
        ways = (_nearest(current, reference), _nearest(reference, current))
        return _where_observed(np.fmax(*(self._by_tile(distances) for distances in ways)), pairs)

    def _by_tile(self, distances: Sequence[Floats]) -> Floats:
        if self.statistic == "mean":
            return _means(distances)
        return _means([(part > FAR).astype(np.float64) for part in distances])


@dataclass(kw_only=True, slots=True)
class M3c2Approximation:
    """M3C2-approx as far as the paper tells: "a PCA-normal point-to-plane approximation" (Table 6).

    Each current point is compared with the plane through its nearest reference point; the tile's score is the
    mean distance in metres. Along the plane nothing is measured, so a removed or a shifted flat thing shows little.
    """

    _known: tuple[Tiles, Normals] | None = field(default=None, init=False)  # of the reference scored last

    @property
    def name(self) -> str:
        return "M3C2-approx"

    def score(self, pairs: TilePairs) -> Floats:
        planes = np.concatenate(pairs.reference.points)
        moved = np.concatenate(pairs.current)
        distance, nearest = cKDTree(planes).query(
            moved, distance_upper_bound=FARTHEST, workers=query_threads()
        )
        met = np.isfinite(distance)
        off = np.full(len(moved), FARTHEST)
        normals = self._normals(pairs.reference, planes)[nearest[met]]
        off[met] = np.abs(np.einsum("ij,ij->i", moved[met] - planes[nearest[met]], normals))
        return _where_observed(_means(_parts(off, pairs.current)), pairs)

    def _normals(self, reference: Tiles, points: Points) -> Normals:
        if self._known is None or self._known[0] is not reference:
            found = estimate_normals(points, radius=NORMAL_RADIUS, max_neighbors=NORMAL_NEIGHBORS)
            self._known = (reference, found)
        return self._known[1]


def _nearest(points: Sequence[Points], others: Sequence[Points]) -> list[Floats]:
    """For each tile, (n,) metres from its points to the nearest of all the others' points, at most FARTHEST."""
    sought, cloud = np.concatenate(points), np.concatenate(others)
    if not len(cloud):
        return [np.full(len(part), FARTHEST) for part in points]
    distance, _ = cKDTree(cloud).query(sought, distance_upper_bound=FARTHEST, workers=query_threads())
    return _parts(np.minimum(distance, FARTHEST), points)


def _parts(values: Floats, tiles: Sequence[Points]) -> list[Floats]:
    """(N,) -> one array a tile, as its points."""
    return list(np.split(values, np.cumsum([len(part) for part in tiles])[:-1]))


def _means(parts: Sequence[Floats]) -> Floats:
    """(T,) NaN for a tile without points."""
    return np.array([part.mean() if len(part) else np.nan for part in parts])


def _where_observed(scores: Floats, pairs: TilePairs) -> Floats:
    return np.where(pairs.observed, scores, np.nan)
