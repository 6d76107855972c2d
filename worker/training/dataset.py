"""The training set: dense tiles, each seen on two visits and sometimes more, in one .npz file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud import npz
from worker.cloud.types import Points


@dataclass(frozen=True, kw_only=True, slots=True)
class Observation:
    """A further observation of a tile whose truth is known without anybody's labels."""

    tile: int  #: its place in the set
    points: Points  #: (n, 3) float32, metres, relative to the tile's centre
    changed: bool  #: whether the tile is another than `points_a` shows
    rebuilt: bool  #: of the first visit's own scans, fused anew; otherwise of a visit of its own


@dataclass(frozen=True, kw_only=True, slots=True)
class TileSet:
    """T dense tiles before any sampling, fused at 5 cm.

    Nothing changed between the two visits: `points_a` and `points_b` differ as two honest surveys do.
    """

    points_a: tuple[Points, ...]  #: T arrays (n, 3) float32, metres, relative to the tile's centre
    points_b: tuple[Points, ...]  #: the same tiles on a second visit; (0, 3) where there was none
    observations: tuple[Observation, ...]  #: further ones of the same tiles; changed or not
    centres: NDArray[np.float64]  #: (T, 3) metres, frame of the tile's own building
    buildings: NDArray[np.int32]  #: (T,) which building the tile is of
    tile_size: tuple[float, float, float]  #: metres
    source: str  #: how it was made, in words or with the command

    def __len__(self) -> int:
        return len(self.points_a)

    @property
    def half(self) -> NDArray[np.float32]:
        """(3,) metres, half the tiles' size."""
        return (np.asarray(self.tile_size) / 2).astype(np.float32)

    def subset(self, chosen: NDArray[np.bool_]) -> TileSet:
        """Return the tiles where `chosen` (T,) is true."""
        kept, place = np.flatnonzero(chosen).tolist(), np.cumsum(chosen) - 1
        return TileSet(
            points_a=tuple(self.points_a[i] for i in kept),
            points_b=tuple(self.points_b[i] for i in kept),
            observations=tuple(
                replace(observation, tile=int(place[observation.tile]))
                for observation in self.observations
                if chosen[observation.tile]
            ),
            centres=self.centres[chosen],
            buildings=self.buildings[chosen],
            tile_size=self.tile_size,
            source=self.source,
        )


def save_tiles(tiles: TileSet, path: Path) -> None:
    """Keep the set, its points in float16.

    Half precision is 0.5 mm at a tile's edge, below the simulated sensor's rounding of 1 mm.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    npz.save(path, _in_precision(tiles, np.float16))


def load_tiles(path: Path) -> TileSet:
    """Read what `save_tiles` kept. Raises ValueError for any other file, that of an earlier release among them."""
    try:
        return _in_precision(npz.load(path, TileSet), np.float32)
    except ValueError as error:
        raise ValueError(f"{path} is no training set of this release; build it again ({error})") from error


def _in_precision(tiles: TileSet, kind: type[np.floating[Any]]) -> TileSet:
    """Return the same set with its points in another type."""

    def cast(clouds: tuple[Points, ...]) -> tuple[Points, ...]:
        return tuple(points.astype(kind) for points in clouds)

    observations = zip(tiles.observations, cast(tuple(one.points for one in tiles.observations)), strict=True)
    return replace(
        tiles,
        points_a=cast(tiles.points_a),
        points_b=cast(tiles.points_b),
        observations=tuple(replace(observation, points=points) for observation, points in observations),
    )


def joined(parts: Sequence[TileSet], *, source: str) -> TileSet:
    """Return the tiles of several sets in one, each set a building of its own. Raises ValueError for none."""
    if not parts:
        raise ValueError("a training set needs a building")
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    return TileSet(
        points_a=tuple(points for part in parts for points in part.points_a),
        points_b=tuple(points for part in parts for points in part.points_b),
        observations=tuple(
            replace(observation, tile=observation.tile + start)
            for part, start in zip(parts, starts, strict=False)
            for observation in part.observations
        ),
        centres=np.concatenate([part.centres for part in parts]),
        buildings=np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in parts]),
        tile_size=parts[0].tile_size,
        source=source,
    )


def split_tiles(tiles: TileSet, *, share: float = 0.1, seed: int = 42) -> tuple[TileSet, TileSet]:
    """Split into training and validation tiles (paper, Section 3.8: a spatial 90/10 split).

    From every building the `share` of tiles nearest to a random one of its outermost tiles, a region in one
    piece, is held out.
    """
    held_out = np.zeros(len(tiles), dtype=bool)
    rng = np.random.default_rng(seed)
    for building in np.unique(tiles.buildings):
        members = np.flatnonzero(tiles.buildings == building)
        centres = tiles.centres[members]
        direction = rng.normal(size=2)
        outermost = centres[int((centres[:, :2] @ direction).argmax())]
        distance = np.linalg.norm(centres[:, :2] - outermost[:2], axis=1)
        held_out[members[np.argsort(distance, kind="stable")[: round(share * len(members))]]] = True
    return tiles.subset(~held_out), tiles.subset(held_out)
