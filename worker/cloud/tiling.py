"""Tiles: the map and the survey cut along one regular grid (paper, Section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from worker.cloud.settings import StrictModel
from worker.cloud.types import Bools, Floats, Indices, Points
from worker.errors import MapFailed

_MOST_TILES = 10_000_000  # of a grid's box; a wider one means stray points, not a building

_AT_ONCE = 1_000_000  # points that are located together


#: `dense`: tiles of the map with enough points to compare patches; `touched`: all that either visit has a point in
TileChoice = Literal["dense", "touched"]


class TilingSettings(StrictModel):
    """Section 3.4 and Table 3 of the paper; tile size and points come from the model's card."""

    tile_size: tuple[float, float, float] = Field((1.5, 1.5, 1.0), description="metres")
    tiles: TileChoice = Field("dense", description="those with enough points of the map, or all touched")
    min_points: int = Field(512, gt=0, description="dense tiles of the map with fewer points are left out")
    min_observed_share: float = Field(
        0.5,
        ge=0,
        le=1,
        description="of the reference's points; a survey that saw less did not observe the tile",
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class TileGrid:
    """A regular grid in the map frame; tile (i, j, k) starts at `origin + (i, j, k) * size`.

    Indices below zero come with a map that grew: tiles keep their ids from version to version. Its arrays cannot be
    written to, for all tiles of a map share them.
    """

    origin: Floats  #: (3,) metres, map frame, minimum corner of tile (0, 0, 0)
    size: Floats  #: (3,) metres
    shape: tuple[int, int, int]  #: number of tiles along x, y, z
    lowest: tuple[int, int, int] = (0, 0, 0)  #: indices of the first tile

    def __post_init__(self) -> None:
        for name in ("origin", "size"):
            fixed = getattr(self, name).view()
            fixed.flags.writeable = False
            object.__setattr__(self, name, fixed)

    def lower(self, indices: Indices) -> Floats:
        """Return (T, 3) metres, map frame: minimum corners."""
        return self.origin + indices * self.size

    def centers(self, indices: Indices) -> Floats:
        """Return (T, 3) metres, map frame."""
        return self.origin + (indices + 0.5) * self.size

    def locate(self, points: Points | Floats) -> NDArray[np.int64]:
        """Return (N,) the cell that holds each point (N, 3), metres, map frame; -1 outside the grid.

        A cell is the flat number of a tile within `shape`, so that cells sort as tiles do.
        """
        cells = np.empty(len(points), np.int64)
        for start in range(0, len(points), _AT_ONCE):
            at = slice(start, start + _AT_ONCE)
            cells[at] = self.cells(np.floor((points[at] - self.origin) / self.size).astype(np.int64))
        return cells

    def cells(self, indices: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """Return (T,) the cell of each tile (T, 3); -1 outside the grid."""
        cells = np.zeros(len(indices), np.int64)
        inside = np.ones(len(indices), bool)
        for axis, (lowest, count) in enumerate(
            zip(self.lowest, self.shape, strict=True)
        ):  # faster than by rows
            place = indices[:, axis].astype(np.int64) - lowest
            inside &= (place >= 0) & (place < count)
            cells *= count
            cells += place
        cells[~inside] = -1
        return cells

    def locate_among(self, points: Points | Floats, indices: Indices) -> NDArray[np.int64]:
        """Return (N,) the row in `indices` (T, 3) of the tile that holds each point (N, 3); -1 where none does."""
        wanted, cells = self.cells(indices), self.locate(points)
        if not len(wanted):
            return np.full(len(points), -1, np.int64)
        order = np.argsort(wanted)
        place = np.searchsorted(wanted, cells, sorter=order).clip(max=len(wanted) - 1)
        rows: NDArray[np.int64] = np.where((wanted[order[place]] == cells) & (cells >= 0), order[place], -1)
        return rows


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

    def subset(self, chosen: NDArray[np.intp]) -> TilePairs:
        """Return the pairs at these places (t,) alone; a place may come twice."""
        reference = replace(
            self.reference,
            indices=self.reference.indices[chosen],
            points=tuple(self.reference.points[tile] for tile in chosen),
        )
        current = tuple(self.current[tile] for tile in chosen)
        return TilePairs(reference=reference, current=current, observed=self.observed[chosen])


def tile_id(index: NDArray[np.int32]) -> str:
    """Return `tile_III_JJJ_KKK` (paper, Table A1)."""
    i, j, k = (int(number) for number in index)
    return f"tile_{i:03d}_{j:03d}_{k:03d}"


def grid_over(points: Points, *, tile_size: tuple[float, float, float], voxel_size: float) -> TileGrid:
    """Return the grid that starts at the map's minimum corner, snapped down to a voxel so that no voxel is cut in two.

    Raises MapFailed where the points span more tiles than a building has.
    """
    size = np.asarray(tile_size, np.float64)
    origin = np.floor(points.min(axis=0).astype(np.float64) / voxel_size) * voxel_size
    return _spanned(points, origin, size)


def grown(grid: TileGrid, points: Points) -> TileGrid:
    """Return the grid over the points of a newer version; a tile of both keeps its index. Raises MapFailed."""
    return _spanned(points, grid.origin, grid.size)


def _spanned(points: Points, origin: Floats, size: Floats) -> TileGrid:
    least, most = (np.array([end(points[:, axis]) for axis in range(3)]) for end in (np.min, np.max))
    low = np.floor((least - origin) / size).astype(np.int64)
    count = np.floor((most - origin) / size).astype(np.int64) + 1 - low
    if count.prod() > _MOST_TILES:
        extent = " x ".join(f"{edge:.0f}" for edge in count * size)
        raise MapFailed(f"the map spans {extent} m; remove stray points, or cut it into several maps")
    shape, lowest = (tuple(int(value) for value in values) for values in (count, low))
    return TileGrid(
        origin=origin,
        size=size,
        shape=(shape[0], shape[1], shape[2]),
        lowest=(lowest[0], lowest[1], lowest[2]),
    )


def cut(points: Points, grid: TileGrid, *, min_points: int) -> Tiles:
    """Sort points (N, 3) of the map frame into tiles; those with fewer than `min_points` are left out."""
    located = grid.locate(points).astype(np.int32)  # there are no more than `_MOST_TILES`
    order = np.argsort(located, kind="stable")
    located = located[order]
    starts = np.flatnonzero(np.r_[len(located) > 0, located[1:] != located[:-1]])
    cells = located[starts].astype(np.int64)
    parts = np.split(points[order].astype(np.float32, copy=False), starts[1:])
    # without a point there is no cell and one empty part
    dense = [
        (cell, part)
        for cell, part in zip(cells, parts, strict=False)
        if cell >= 0 and len(part) >= min_points
    ]
    kept = np.array([cell for cell, _ in dense], np.int64)
    return Tiles(
        grid=grid,
        indices=_indices_of(kept, grid),
        points=tuple(part for _, part in dense),
    )


def _indices_of(cells: NDArray[np.int64], grid: TileGrid) -> Indices:
    return (np.stack(np.unravel_index(cells, grid.shape), axis=1) + grid.lowest).astype(np.int32)


def touched_tiles(reference: Points, current: Points, grid: TileGrid) -> Tiles:
    """Sort the map's points (N, 3) into all tiles in which it or the survey (M, 3) has a point, in the grid's order.

    The grid grows to hold both; tiles that only the survey touched are empty. Raises MapFailed as `grown` does.
    """
    grid = grown(grid, np.concatenate([reference, current]))
    mapped = cut(reference, grid, min_points=1)
    cells = np.unique(np.concatenate([grid.cells(mapped.indices), grid.locate(current)]))
    rows = {int(cell): row for row, cell in enumerate(grid.cells(mapped.indices))}
    nothing = np.empty((0, 3), np.float32)
    points = tuple(mapped.points[rows[int(cell)]] if int(cell) in rows else nothing for cell in cells)
    return Tiles(grid=grid, indices=_indices_of(cells, grid), points=points)


def pair_tiles(reference: Tiles, current: Points, *, settings: TilingSettings) -> TilePairs:
    """Put beside each reference tile the survey's points (N, 3), map frame, of the same box (Section 3.9.2)."""
    rows = reference.grid.locate_among(current, reference.indices)
    counts = np.bincount(rows + 1, minlength=len(reference.indices) + 1)  # first those in no tile
    ordered = current[np.argsort(rows, kind="stable")].astype(np.float32, copy=False)
    points = tuple(np.split(ordered, np.cumsum(counts)[:-1])[1:])
    expected = np.array([len(part) for part in reference.points]) * settings.min_observed_share
    fewest = settings.min_points if settings.tiles == "dense" else 1
    observed = (counts[1:] >= fewest) & (counts[1:] >= expected)
    return TilePairs(reference=reference, current=points, observed=observed)
