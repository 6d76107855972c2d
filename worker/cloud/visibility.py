"""Whether a cloud can have been seen from one place: what its sensor pose is worth.

A standing scanner sees one surface in each direction. A phone's walk through a room, a cloud merged from many
scans, or a file whose frame is not the sensor's has points behind points, and then nothing can be concluded
about which side of a wall was seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Floats

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


MARGIN = (
    0.05,
    0.3,
)  #: times the range, plus metres, that a point must stand nearer than what was seen behind it


@dataclass(frozen=True, kw_only=True, slots=True)
class RangeImage:
    """The nearest return in each direction from one place, eroded by a cell, so that edges prove nothing."""

    origin: Floats  #: (3,) metres, frame of the scan
    ranges: Floats  #: (6 CELLS^2,) metres; 0 where nothing is known

    @classmethod
    def of(cls, points: NDArray[Any], origin: Floats) -> RangeImage:
        """Of points (N, 3), metres, all seen from `origin` (3,)."""
        rays = (points - origin).astype(np.float64)
        ranges = np.linalg.norm(rays, axis=1)
        away = ranges > 1e-3
        nearest = np.full(6 * CELLS**2, np.inf)
        np.minimum.at(nearest, cube_cells(rays[away] / ranges[away, None]), ranges[away])
        return cls(origin=origin, ranges=_eroded(nearest))

    def free_space_violation(self, points: Floats) -> NDArray[np.bool_]:
        """(N,) which points (N, 3), metres, frame of the scan, stand well before what was seen in their direction."""
        rays = points - self.origin
        ranges = np.linalg.norm(rays, axis=1)
        behind = self.ranges[cube_cells(rays / np.maximum(ranges, 1e-9)[:, None])]
        through: NDArray[np.bool_] = ranges * (1 + MARGIN[0]) + MARGIN[1] < behind
        return through


def _eroded(nearest: Floats) -> Floats:
    """The least of each cell and its eight neighbours on the same face; 0 where one of the middle is unknown."""
    faces = nearest.reshape(6, CELLS, CELLS)
    padded = np.pad(faces, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
    shifts = [padded[:, i : i + CELLS, j : j + CELLS] for i in range(3) for j in range(3)]
    least = np.minimum.reduce(shifts)
    return np.where(np.isfinite(faces), least, 0.0).ravel()
