"""What a detector is given: a map and a survey in one frame, cut along the map's tiles, with the scans behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from worker.cloud.seen import Seen
from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.cloud.types import Bools, Floats, Indices, Matrix4, Normals, Points


class SeenScan(Protocol):
    """One accepted scan of a visit."""

    @property
    def points(self) -> Points:
        """(N, 3) float32, metres, map frame."""

    @property
    def map_from_scan(self) -> Matrix4:
        """(4, 4) rigid."""

    @property
    def sensor_origin(self) -> Floats | None:
        """(3,) metres, map frame; None where the points cannot all have been seen from one place."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Side:
    """One of the two clouds that are compared."""

    points: Points  #: (M, 3) float32, metres, map frame, one a voxel
    normals: Normals | None = None  #: (M, 3) unit length; None where none were computed
    scans: Sequence[
        Callable[[], SeenScan]
    ] = ()  #: each call loads one, so that a map of 500 never lies in memory
    seen: Seen | None = None  #: None: nobody kept what the scans saw


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Comparison:
    """A map and a survey of it, T tiles of the map."""

    reference: Side
    current: Side
    tile_pairs: TilePairs  #: both clouds cut along the map's tiles
    displaced: Indices | None = None  #: (D, 3) tiles in which the building itself does not lie on the map's

    @property
    def grid(self) -> TileGrid:
        return self.tile_pairs.reference.grid

    @property
    def tiles(self) -> Indices:
        """(T, 3) indices of the map's tiles in the grid."""
        return self.tile_pairs.reference.indices

    @property
    def observed(self) -> Bools:
        """(T,) tiles that the survey saw densely enough to be scored by their points."""
        return self.tile_pairs.observed

    @classmethod
    def of_tiles(cls, pairs: TilePairs) -> Comparison:
        """Compare two clouds of which nothing is known but what lies in the tiles."""
        current = Side(points=_joined(pairs.current))
        return cls(reference=side_of(pairs.reference), current=current, tile_pairs=pairs)


def side_of(tiles: Tiles) -> Side:
    """Return the cloud that tiles make together."""
    return Side(points=_joined(tiles.points))


def _joined(parts: Sequence[Points]) -> Points:
    return np.concatenate([np.empty((0, 3), np.float32), *parts])
