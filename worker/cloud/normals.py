"""Surface normals by principal components of each point's neighbourhood (paper, Table 1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.cloud.types import Normals
from worker.threads import query_threads

SPARSE = 8  #: neighbours below which a wider look is taken
WIDER = 3.0  #: times the radius
AT_ONCE = 1_000_000  #: points that are looked at together


def estimate_normals(points: NDArray[Any], *, radius: float, max_neighbors: int) -> Normals:
    """Estimate unit normals (N, 3) of points (N, 3), metres, from at most `max_neighbors` within `radius` metres.

    Where fewer than `SPARSE` lie so near, the radius is three times as wide: five metres away a standing
    scanner leaves 15 cm between its points, and three of them make no plane but noise, which drags ICP metres
    away. The sign is arbitrary. A large cloud is looked at in slabs across x, with what lies around each: trees and
    neighbours of all its points at once would take ten times its memory.
    """
    if len(points) <= AT_ONCE:
        return _of_slab(points, radius, max_neighbors)
    normals = np.empty((len(points), 3), np.float32)
    order = np.argsort(points[:, 0], kind="stable")
    along = points[order, 0]
    for start in range(0, len(points), AT_ONCE):
        own = slice(start, min(start + AT_ONCE, len(points)))
        reach = (along[own][0] - WIDER * radius, along[own][-1] + WIDER * radius)
        first, last = np.searchsorted(along, reach[0]), np.searchsorted(along, reach[1], side="right")
        found = _of_slab(points[order[first:last]], radius, max_neighbors)
        normals[order[own]] = found[own.start - first : own.stop - first]
    return normals


def _of_slab(points: NDArray[Any], radius: float, max_neighbors: int) -> Normals:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    normals = _estimated(cloud, radius, max_neighbors)
    if len(points) <= SPARSE:
        return normals
    distance, _ = cKDTree(points).query(
        points, k=SPARSE + 1, distance_upper_bound=radius, workers=query_threads()
    )
    sparse = np.isinf(np.asarray(distance)[:, -1])
    if sparse.any():
        normals[sparse] = _estimated(cloud, WIDER * radius, max_neighbors)[sparse]
    return normals


def _estimated(cloud: o3d.geometry.PointCloud, radius: float, max_neighbors: int) -> Normals:
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius, max_neighbors))
    return np.asarray(cloud.normals).astype(np.float32)
