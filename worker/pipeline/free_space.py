"""What a standing scan saw through: points of another scan that stand there contradict the pose.

Two corridors laid over each other with one slid along agree wherever both have walls; but the end wall of one then
stands in the middle of what the other saw as empty. Idea: visibility-based change detection and map cleaning
(e.g. Pomerleau et al., ICRA 2014); here it judges poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.pipeline.values import Floats
from worker.pipeline.visibility import CELLS, cube_cells

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

    def seen_through(self, points: Floats) -> NDArray[np.bool_]:
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
