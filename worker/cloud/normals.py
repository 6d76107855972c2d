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


def estimate_normals(points: NDArray[Any], *, radius: float, max_neighbors: int) -> Normals:
    """Estimate unit normals (N, 3) of points (N, 3), metres, from at most `max_neighbors` within `radius` metres.

    Where fewer than `SPARSE` lie so near, the radius is three times as wide: five metres away a standing
    scanner leaves 15 cm between its points, and three of them make no plane but noise, which drags ICP metres
    away. The sign is arbitrary.
    """
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
