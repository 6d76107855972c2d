"""Surface normals by principal components of each point's neighbourhood (paper, Table 1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from worker.pipeline.values import Normals


def estimate_normals(points: NDArray[Any], *, radius: float, max_neighbors: int) -> Normals:
    """Unit normals (N, 3) of points (N, 3), from at most `max_neighbors` within `radius` metres.

    The sign is arbitrary. A point with fewer than three neighbours gets (0, 0, 1) from Open3D, which is why
    callers that need trust look at the neighbourhood first.
    """
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius, max_neighbors))
    return np.asarray(cloud.normals).astype(np.float32)
