"""What users would do without a network: distances between the two clouds, one score a tile, no training.

Distances are taken between the whole clouds, not tile by tile, so that the border of a tile is no change. A
tile that was not observed gets NaN, a higher score is more change. Scores are in metres or shares; each has a threshold of its own.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.cloud.normals import estimate_normals
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Floats, Normals, Points
from worker.detectors.c2c.detector import (
    FARTHEST,
    distances_both_ways,
    split_by_tile,
    tile_distances,
    tile_means,
)
from worker.detectors.comparison import Comparison
from worker.threads import query_threads

FAR = 0.10  #: metres; two voxels of the fused maps
NORMAL_RADIUS, NORMAL_NEIGHBORS = 0.15, 30  #: metres; of the plane that M3C2-approx puts through a point


@dataclass(frozen=True, kw_only=True, slots=True)
class CloudToCloudBaseline:
    """C2C: nearest distances both ways (Girardeau-Montaut et al. 2005, the paper's [7]).

    `mean` is their mean over the tile's points in metres, `far` the share of points over 10 cm; of the two
    directions the larger counts, so that what was added and what was removed weigh alike.
    """

    statistic: Literal["mean", "far"] = "mean"

    @property
    def name(self) -> str:
        return {"mean": "C2C (mean)", "far": "C2C (share over 10 cm)"}[self.statistic]

    def score(self, pairs: TilePairs) -> Floats:
        comparison = Comparison.of_tiles(pairs)
        if self.statistic == "mean":
            return _where_observed(tile_distances(comparison), pairs)
        ways = distances_both_ways(comparison)
        shares = (tile_means([(part > FAR).astype(np.float64) for part in way]) for way in ways)
        return _where_observed(np.fmax(*shares), pairs)


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
        return _where_observed(tile_means(split_by_tile(off, pairs.current)), pairs)

    def _normals(self, reference: Tiles, points: Points) -> Normals:
        if self._known is None or self._known[0] is not reference:
            normals = estimate_normals(points, radius=NORMAL_RADIUS, max_neighbors=NORMAL_NEIGHBORS)
            self._known = (reference, normals)
        return self._known[1]


def _where_observed(scores: Floats, pairs: TilePairs) -> Floats:
    return np.where(pairs.observed, scores, np.nan)


PACKAGE = "py4dgeo"


def m3c2_is_installed() -> bool:
    """Tell whether `M3c2` can be used."""
    return find_spec(PACKAGE) is not None


@dataclass(frozen=True, kw_only=True, slots=True)
class M3c2:
    """Signed distances along local normals, each with its level of detection.

    The score of a tile is the share of its core points that changed: those whose distance is significant at
    95%, and those with points of one cloud only in their cylinder, for something is gone. Core points are every
    `every`th of the reference.
    """

    every: int = 4
    normal_radius: float = 0.30  #: metres; of the neighbourhood that gives the normal
    cylinder_radius: float = 0.10  #: metres; two voxels, some dozen points of a wall
    #: Metres; half the cylinder's length. py4dgeo cuts it into pieces of a radius and drops what lies exactly on a
    #: cut; with an odd number of pieces none goes through the core point, where flat surfaces lie.
    max_distance: float = 0.9
    registration_error: float = 0.01  #: metres; part of the level of detection

    @property
    def name(self) -> str:
        return "M3C2"

    def score(self, pairs: TilePairs) -> Floats:
        """Return the share of each tile's core points that changed.

        Raises ModuleNotFoundError where py4dgeo is not installed.
        """
        reference = np.concatenate(pairs.reference.points).astype(np.float64)
        current = np.concatenate(pairs.current).astype(np.float64)
        tile = np.repeat(np.arange(len(pairs.current)), [len(part) for part in pairs.reference.points])
        changed = self._changed(reference, current, reference[:: self.every])
        count = np.bincount(tile[:: self.every], minlength=len(pairs.current))
        sums = np.bincount(tile[:: self.every], weights=changed, minlength=len(pairs.current))
        shares = np.divide(sums, count, out=np.zeros(len(count)), where=count > 0)
        return np.where(pairs.observed, shares, np.nan)

    def _changed(self, reference: Floats, current: Floats, core: Floats) -> NDArray[np.bool_]:
        library = _library()
        method = library.M3C2(
            epochs=(library.Epoch(reference), library.Epoch(current)),
            corepoints=core,
            normal_radii=[self.normal_radius],
            cyl_radius=self.cylinder_radius,
            max_distance=self.max_distance,
            registration_error=self.registration_error,
        )
        distances, uncertainties = method.run()
        one_sided = (uncertainties["num_samples1"] > 0) != (uncertainties["num_samples2"] > 0)
        changed: NDArray[np.bool_] = one_sided | (np.abs(distances) > uncertainties["lodetection"])
        return changed


def _library() -> Any:
    """Import py4dgeo, kept from writing to stdout and from leaving a log file in the working folder."""
    import py4dgeo  # noqa: PLC0415 (optional, and three seconds to import)

    logger = logging.getLogger(PACKAGE)
    for handler in logger.handlers[:]:
        handler.close()
        logger.removeHandler(handler)
    logger.setLevel(logging.ERROR)
    return py4dgeo


Baseline = CloudToCloudBaseline | M3c2Approximation | M3c2


def installed_baselines() -> tuple[Baseline, ...]:
    """Return those that this machine can run: the real M3C2 needs a library that is an extra of the install."""
    always = (CloudToCloudBaseline(), CloudToCloudBaseline(statistic="far"), M3c2Approximation())
    return (*always, M3c2()) if m3c2_is_installed() else always
