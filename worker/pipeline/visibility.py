"""Whether a cloud can have been seen from one place: what its sensor pose is worth.

A standing scanner sees one surface in each direction. A phone's walk through a room, a cloud merged from many
scans, or a file whose frame is not the sensor's has points behind points, and then nothing can be concluded
about which side of a wall was seen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: At least this share stands in front. Measured: simulated scans 0.95 to 0.99, `room_scan` 0.97, Kinect frames
#: 0.87 to 0.89; scans assembled on the way 0.70 to 0.85, merged maps 0.17 to 0.34.
ENOUGH = 0.85
CELLS = 45  #: along a face of the cube: 2 degrees
_DEPTH = (1.1, 0.2)  # times the nearest range, plus metres: still the same surface


def share_in_front(points: NDArray[Any], origin: NDArray[Any]) -> float:
    """Share (0..1) of points (N, 3), metres, with nothing much nearer to `origin` (3,) in their direction."""
    rays = (points - origin).astype(np.float64)
    ranges = np.linalg.norm(rays, axis=1)
    away = ranges > 1e-3
    rays, ranges = rays[away] / ranges[away, None], ranges[away]
    if not len(rays):
        return 0.0
    cell = cube_cells(rays)
    nearest = np.full(6 * CELLS**2, np.inf)
    np.minimum.at(nearest, cell, ranges)
    return float(np.mean(ranges < nearest[cell] * _DEPTH[0] + _DEPTH[1]))


def cube_cells(rays: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) cell of a cube around the origin that each unit ray (N, 3) goes through."""
    axis = np.abs(rays).argmax(axis=1)
    along = np.take_along_axis(rays, axis[:, None], axis=1)
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    across = np.take_along_axis(rays, others, axis=1) / np.abs(along)  # (N, 2) in -1..1
    u, v = np.clip(((across + 1) / 2 * CELLS).astype(np.int64), 0, CELLS - 1).T
    face = axis * 2 + (along[:, 0] > 0)
    cells: NDArray[np.int64] = (face * CELLS + u) * CELLS + v
    return cells
