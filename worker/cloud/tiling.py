"""Tiles: the map and the survey cut along one regular grid (paper, Section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from worker.cloud.types import Bools, Floats, Indices, Points
from worker.errors import MapFailed

_MOST_TILES = 10_000_000  # of a grid's box; a wider one means stray points, not a building


class TilingSettings(BaseModel):
    """Section 3.4 and Table 3 of the paper; the values come from the model's card."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tile_size: tuple[float, float, float] = Field((1.5, 1.5, 1.0), description="metres")
    min_points: int = Field(512, gt=0, description="tiles of the map with fewer points are left out")
    min_observed_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="of the reference's points; a survey that saw less did not observe the tile",
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class TileGrid:
    """A regular grid in the map frame; tile (i, j, k) starts at `origin + (i, j, k) * size`.

    Indices below zero come with a map that grew: tiles keep their ids from version to version.
    """

    origin: Floats  #: (3,) metres, map frame, minimum corner of tile (0, 0, 0)
    size: Floats  #: (3,) metres
    shape: tuple[int, int, int]  #: number of tiles along x, y, z
    lowest: tuple[int, int, int] = (0, 0, 0)  #: indices of the first tile

    def lower(self, indices: Indices) -> Floats:
        """(T, 3) metres, map frame: minimum corners."""
        return self.origin + indices * self.size

    def centers(self, indices: Indices) -> Floats:
        """(T, 3) metres, map frame."""
        return self.origin + (indices + 0.5) * self.size


@dataclass(frozen=True, kw_only=True, slots=True)
class Tiles:
    """The dense points of each tile, before any sampling."""

    grid: TileGrid
    indices: Indices  #: (T, 3) int32
    points: tuple[Points, ...]  #: T arrays (n, 3) float32, metres, map frame


@dataclass(frozen=True, kw_only=True, slots=True)
class TilePairs:
    """Each tile of the reference beside what the survey saw in the same box."""

    reference: Tiles
    current: tuple[Points, ...]  #: T arrays (n, 3) float32, metres, map frame; n may be 0
    observed: Bools  #: (T,) seen densely enough in the survey to be scored


def tile_id(index: NDArray[np.int32]) -> str:
    """`tile_III_JJJ_KKK` (paper, Table A1)."""
    i, j, k = (int(number) for number in index)
    return f"tile_{i:03d}_{j:03d}_{k:03d}"


def grid_over(points: Points, *, tile_size: tuple[float, float, float], voxel_size: float) -> TileGrid:
    """The grid that starts at the map's minimum corner, snapped down to a voxel so that no voxel is cut in two.

    Raises MapFailed where the points span more tiles than a building has.
    """
    size = np.asarray(tile_size, np.float64)
    origin = np.floor(points.min(axis=0).astype(np.float64) / voxel_size) * voxel_size
    return _spanned(points, origin, size)


def grown(grid: TileGrid, points: Points) -> TileGrid:
    """The same grid over the points of a newer version; a tile that both have keeps its index. Raises MapFailed."""
    return _spanned(points, grid.origin, grid.size)


def _spanned(points: Points, origin: Floats, size: Floats) -> TileGrid:
    low = np.floor((points.min(axis=0) - origin) / size).astype(np.int64)
    count = np.floor((points.max(axis=0) - origin) / size).astype(np.int64) + 1 - low
    if count.prod() > _MOST_TILES:
        extent = " x ".join(f"{edge:.0f}" for edge in count * size)
        raise MapFailed(f"the map spans {extent} m; remove stray points, or cut it into several maps")
    shape, lowest = (tuple(int(value) for value in each) for each in (count, low))
    return TileGrid(
        origin=origin,
        size=size,
        shape=(shape[0], shape[1], shape[2]),
        lowest=(lowest[0], lowest[1], lowest[2]),
    )


def cut(points: Points, grid: TileGrid, *, min_points: int) -> Tiles:
    """Sort points (N, 3) of the map frame into tiles; those with fewer than `min_points` are left out."""
    cells, starts, ordered = _by_cell(points, grid)
    bounds = np.append(starts, len(ordered))
    kept = np.flatnonzero(np.diff(bounds) >= min_points)
    return Tiles(
        grid=grid,
        indices=(np.stack(np.unravel_index(cells[kept], grid.shape), axis=1) + grid.lowest).astype(np.int32),
        points=tuple(ordered[bounds[tile] : bounds[tile + 1]] for tile in kept),
    )


def pair_tiles(reference: Tiles, current: Points, *, settings: TilingSettings) -> TilePairs:
    """Put beside each reference tile the survey's points (N, 3), map frame, of the same box (Section 3.9.2)."""
    cells, starts, ordered = _by_cell(current, reference.grid)
    bounds = np.append(starts, len(ordered))
    grid = reference.grid
    wanted = np.ravel_multi_index(tuple((reference.indices - grid.lowest).T), grid.shape)
    place = np.searchsorted(cells, wanted)
    found = place < len(cells)
    found[found] = cells[place[found]] == wanted[found]
    nothing = np.empty((0, 3), np.float32)
    points = tuple(
        ordered[bounds[at] : bounds[at + 1]] if there else nothing
        for at, there in zip(place, found, strict=True)
    )
    seen = np.array([len(part) for part in points])
    expected = np.array([len(part) for part in reference.points]) * settings.min_observed_share
    return TilePairs(
        reference=reference, current=points, observed=(seen >= settings.min_points) & (seen >= expected)
    )


def inside_tiles(points: Points, grid: TileGrid, indices: Indices) -> Bools:
    """(N,) which points (N, 3) of the map frame lie in one of the tiles (T, 3)."""
    cells = np.floor((points - grid.origin) / grid.size).astype(np.int64) - grid.lowest
    within = np.all((cells >= 0) & (cells < grid.shape), axis=1)
    wanted = indices.astype(np.int64) - grid.lowest
    wanted = wanted[np.all((wanted >= 0) & (wanted < grid.shape), axis=1)]
    found = np.zeros(len(points), bool)
    found[within] = np.isin(
        np.ravel_multi_index(tuple(cells[within].T), grid.shape),
        np.ravel_multi_index(tuple(wanted.T), grid.shape),
    )
    return found


def _by_cell(points: Points, grid: TileGrid) -> tuple[NDArray[np.int64], NDArray[np.intp], Points]:
    """The occupied cells (flat, ascending), where each begins, and the points ordered by cell."""
    index = np.floor((points - grid.origin) / grid.size).astype(np.int64) - grid.lowest
    inside = np.all((index >= 0) & (index < grid.shape), axis=1)
    flat = np.ravel_multi_index(tuple(index[inside].T), grid.shape)
    order = np.argsort(flat, kind="stable")
    cells, starts = np.unique(flat[order], return_index=True)
    return cells, starts, points[inside][order].astype(np.float32, copy=False)
