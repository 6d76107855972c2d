"""An octree over a cube: where each point lies along the Morton curve, and which points stand for a cell.

Of each cell of a level one point is its sample: the one whose hash is least. The sample of a cell is the sample of the
smaller cell that it lies in as well, so that the samples of all levels are nested, and each point has one level from
which on it is shown (hierarchical jittered sampling; compare Schuetz et al., Fast Out-of-Core Octree Generation for
Massive Point Clouds, 2020). It depends on the points and the cube alone, not on the order of work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Bools, Floats, Points

Codes = NDArray[np.uint64]  #: (N,) places along the Morton curve: bits of z, y, x in turn, 21 of each

BITS = 21  #: of an axis
GRID_BITS = 6  #: a node shows one point in each cell of a grid of 64 cells a side
DEEPEST = BITS - GRID_BITS  #: level of the nodes whose cells are the finest


@dataclass(frozen=True, kw_only=True, slots=True)
class Cube:
    """The root of an octree."""

    lower: Floats  #: (3,) metres
    side: float  #: metres

    @classmethod
    def around(cls, lower: NDArray[Any], upper: NDArray[Any]) -> Cube:
        """Return the cube at this corner that holds the box."""
        lower = lower.astype(np.float64)
        widest = float((upper.astype(np.float64) - lower).max())
        return cls(lower=lower, side=widest * (1 + 1e-6) or 1.0)

    def codes(self, points: Points) -> Codes:
        """Return the place of each point (N, 3) within the cube."""
        cells = ((points - self.lower) * ((1 << BITS) / self.side)).astype(np.int64)
        x, y, z = np.clip(cells, 0, (1 << BITS) - 1).astype(np.uint64).T
        codes: Codes = _spread(x) | (_spread(y) << np.uint64(1)) | (_spread(z) << np.uint64(2))
        return codes

    def spacing(self, level: int) -> float:
        """Return the edge, metres, of the cells of which a node of this level shows one point each."""
        return self.side / (1 << (GRID_BITS + level))


def node_of(codes: Codes, level: int) -> Codes:
    """Return (N,) the number of the node of this level that each place lies in; the root's level is 0."""
    return codes >> np.uint64(3 * (BITS - level))


def samples(codes: Codes, level: int) -> Bools:
    """Tell (N,) of places, ascending, which are the samples of the cells of a node of this level."""
    cells = codes >> np.uint64(3 * (BITS - GRID_BITS - level))
    hashes = _hashed(codes)
    first = np.r_[True, cells[1:] != cells[:-1]]
    starts = np.flatnonzero(first)
    least = np.repeat(np.minimum.reduceat(hashes, starts), np.diff(np.r_[starts, len(cells)]))
    candidates = np.flatnonzero(hashes == least)  # several where points share a place
    cell = cells[candidates]
    chosen = np.zeros(len(codes), bool)
    chosen[candidates[np.r_[True, cell[1:] != cell[:-1]]]] = True
    return chosen


def _spread(values: Codes) -> Codes:
    """Put two zeros between the 21 bits of each number."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values


def _hashed(codes: Codes) -> Codes:
    """Return a number for each place that looks random (SplitMix64: Steele, Lea and Flood, 2014)."""
    mixed = codes + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> np.uint64(31))
