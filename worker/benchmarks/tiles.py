"""Which tile a point lies in, and some of the tile pairs by themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import TileGrid, TilePairs
from worker.cloud.types import Floats, Indices, Points


def tiles_of(points: Points | Floats, grid: TileGrid) -> NDArray[np.int64]:
    """Return the flat cell of each point (N, 3), map frame: (N,), -1 outside the grid."""
    cells = np.floor((points - grid.origin) / grid.size).astype(np.int64)
    flat: NDArray[np.int64] = np.full(len(points), -1, np.int64)
    inside = np.all((cells >= grid.lowest) & (cells < np.add(grid.lowest, grid.shape)), axis=1)
    flat[inside] = flat_cells(cells[inside], grid)
    return flat


def flat_cells(indices: Indices | NDArray[np.int64], grid: TileGrid) -> NDArray[np.int64]:
    """Return the flat cells (N,) of tile indices (N, 3) within the grid."""
    place = (indices.astype(np.int64) - np.array(grid.lowest)).T
    return np.asarray(np.ravel_multi_index(tuple(place), grid.shape), np.int64)


def selected(pairs: TilePairs, chosen: NDArray[np.intp]) -> TilePairs:
    """Return the pairs at these places (t,) alone; a place may come twice."""
    reference = replace(
        pairs.reference,
        indices=pairs.reference.indices[chosen],
        points=tuple(pairs.reference.points[tile] for tile in chosen),
    )
    current = tuple(pairs.current[tile] for tile in chosen)
    return TilePairs(reference=reference, current=current, observed=pairs.observed[chosen])
