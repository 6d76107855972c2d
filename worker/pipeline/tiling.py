"""Tiles: the map and the survey cut along one regular grid (paper, Section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

from worker.pipeline.values import Bools, Floats, Indices, Points


@dataclass(frozen=True, kw_only=True, slots=True)
class TileGrid:
    """A regular grid in the map frame; tile (i, j, k) starts at `origin + (i, j, k) * size`."""

    origin: Floats  #: (3,) metres, map frame, minimum corner of tile (0, 0, 0)
    size: Floats  #: (3,) metres
    shape: tuple[int, int, int]  #: number of tiles along x, y, z


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
