"""Displacement: where the building itself does not lie on the map, though the survey as a whole is in its place.

A wall that stands a hand's breadth beside itself is no change that anybody made: a scan of the map or of the survey is
off there. What is said of things nearby is then not to be trusted.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import TileGrid
from worker.cloud.types import Indices
from worker.pipeline.placement.contradictions import INTO_MAP, INTO_SCAN, Held

_SHARE = 0.5  # of a tile's walls, floor and ceiling, off the other visit's, in both directions
_FEWEST = (
    12  # points of each visit that have to be compared in a tile, of some thousands that a scan was asked for
)


def displaced_tiles(held: Iterable[tuple[Held, Held]], grid: TileGrid) -> Indices:
    """Return (T, 3) the tiles, of any index, in which most of the building is off in either visit's eyes.

    `held` are the scans of a survey against the map, and the map against them, at their final poses.
    """
    held = list(held)
    if not held:
        return np.empty((0, 3), np.int32)
    both = [np.concatenate([_compared(pair[way], grid) for pair in held]) for way in (INTO_MAP, INTO_SCAN)]
    tiles, inverse = np.unique(np.concatenate(both)[:, :3], axis=0, return_inverse=True)
    ways = np.split(inverse, [len(both[0])])
    off = np.ones(len(tiles), bool)
    for rows, tile in zip(both, ways, strict=True):
        count = np.bincount(tile, minlength=len(tiles))
        away = np.bincount(tile, rows[:, 3], len(tiles))
        off &= (count >= _FEWEST) & (away >= _SHARE * np.maximum(count, 1))
    displaced: Indices = tiles[off].astype(np.int32)
    return displaced


def _compared(held: Held, grid: TileGrid) -> NDArray[np.int64]:
    """Return (N, 4) the tile of each point of the building that was compared, and whether it is off."""
    rows = held.building & held.near
    tiles = np.floor((held.points[rows] - grid.origin) / grid.size).astype(np.int64)
    return np.column_stack([tiles, held.off[rows]])
