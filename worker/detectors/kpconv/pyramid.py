"""A cloud at several sizes of a grid, and who is whose neighbour (Thomas et al. 2019, Section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Points
from worker.detectors.siamese.prepared import starts

Rows = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Neighbours:
    """E pairs of a point and one in the ball around it, sorted by the former; rows of all clouds end to end."""

    centres: Rows  #: (E,)
    points: Rows  #: (E,)
    counts: Rows  #: (C,) pairs of each centre, one at least


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Pyramid:
    """B clouds end to end at L levels."""

    points: tuple[Points, ...]  #: L arrays (n, 3), metres
    within: tuple[Neighbours, ...]  #: L, of each level's points in that level
    below: tuple[Neighbours, ...]  #: L - 1, of the points of levels 1 on in the level before
    sizes: list[int]  #: (B,) points of each cloud in the last level


def pyramid(clouds: Sequence[Points], *, cell: float, levels: int, reach: float) -> Pyramid:
    """Subsample distinct points (n, 3) of each cloud to twice the cell from level to level.

    The first level is the cloud as it comes, `cell` metres apart or so; neighbours lie within `reach` cells of the level
    that they are of. Any order of the points gives the same pyramid.
    """
    each = [_levels(cloud, cell, levels) for cloud in clouds]
    radii = [reach * cell * 2**level for level in range(levels)]
    points = list(zip(*each, strict=True))  # of each level, the clouds'
    pairs = list(zip(points, points[1:], radii, strict=False))
    return Pyramid(
        points=tuple(np.concatenate(parts) for parts in points),
        within=tuple(_end_to_end(parts, parts, radius) for parts, radius in zip(points, radii, strict=True)),
        below=tuple(_end_to_end(coarse, fine, radius) for fine, coarse, radius in pairs),
        sizes=[len(cloud) for cloud in points[-1]],
    )


def _levels(points: Points, cell: float, levels: int) -> list[Points]:
    result = [points[np.lexsort(points.T)]]
    for level in range(1, levels):
        result.append(subsampled(result[-1], cell * 2**level))
    return result


def subsampled(points: Points, cell: float) -> Points:
    """Return the barycentre (m, 3) of the points (n, 3) in each cell of a grid, its size in metres."""
    cells = np.floor(points / cell).astype(np.int64)
    _, place, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(place.ravel(), weights=column) for column in points.T]
    return (np.stack(sums, axis=1) / counts[:, None]).astype(np.float32)


def neighbours(centres: Points, points: Points, radius: float) -> Neighbours:
    """Return who of (n, 3) points lies within `radius` of each of (C, 3) centres, metres."""
    rows, columns = _pairs(centres, points, radius)
    order = np.lexsort((columns, rows))
    counts = np.bincount(rows, minlength=len(centres))
    return Neighbours(centres=rows[order], points=columns[order], counts=counts)


def _pairs(centres: Points, points: Points, radius: float) -> tuple[Rows, Rows]:
    try:
        from scipy.spatial import cKDTree  # noqa: PLC0415 (optional where only training runs)
    except ImportError:
        return pairs_numpy(centres, points, radius)
    here, there = (cKDTree(cloud, balanced_tree=False) for cloud in (centres, points))
    pairs = here.sparse_distance_matrix(there, radius, output_type="ndarray")
    return pairs["i"], pairs["j"]


def pairs_numpy(centres: Points, points: Points, radius: float) -> tuple[Rows, Rows]:
    """Do as the k-d tree with no library but NumPy, by all distances."""
    offsets = centres[:, None].astype(np.float64) - points
    rows, columns = np.nonzero(np.einsum("cnk,cnk->cn", offsets, offsets) <= radius**2)
    return rows, columns


def _end_to_end(centres: Sequence[Points], points: Sequence[Points], radius: float) -> Neighbours:
    parts = [neighbours(here, there, radius) for here, there in zip(centres, points, strict=True)]
    first_centre, first_point = starts(list(map(len, centres))), starts(list(map(len, points)))
    return Neighbours(
        centres=np.concatenate([part.centres + at for part, at in zip(parts, first_centre, strict=True)]),
        points=np.concatenate([part.points + at for part, at in zip(parts, first_point, strict=True)]),
        counts=np.concatenate([part.counts for part in parts]),
    )
