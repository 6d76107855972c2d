"""The training set: dense tiles, each seen on two visits and sometimes more, in one .npz file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Points

FORMAT = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """A further look at a tile whose truth is known without anybody's labels."""

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
    looks: tuple[Look, ...]  #: further ones, of the first look's tiles; changed or not
    centres: NDArray[np.float64]  #: (T, 3) metres, frame of the tile's own building
    buildings: NDArray[np.int32]  #: (T,) which building the tile is of
    tile_size: tuple[float, float, float]  #: metres
    source: str  #: how it was made, in words or with the command

    def __len__(self) -> int:
        return len(self.points_a)

    def subset(self, chosen: NDArray[np.bool_]) -> TileSet:
        """The tiles where `chosen` (T,) is true."""
        kept, place = np.flatnonzero(chosen).tolist(), np.cumsum(chosen) - 1
        return TileSet(
            points_a=tuple(self.points_a[i] for i in kept),
            points_b=tuple(self.points_b[i] for i in kept),
            looks=tuple(
                replace(look, tile=int(place[look.tile])) for look in self.looks if chosen[look.tile]
            ),
            centres=self.centres[chosen],
            buildings=self.buildings[chosen],
            tile_size=self.tile_size,
            source=self.source,
        )


def save_tiles(tiles: TileSet, path: Path) -> None:
    """Write one .npz: all points end to end in float16, and where each tile begins.

    Half precision is 0.5 mm at a tile's edge, below the simulated sensor's rounding of 1 mm.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        points_a, offsets_a = _packed(tiles.points_a)
        points_b, offsets_b = _packed(tiles.points_b)
        points_looks, offsets_looks = _packed(tuple(look.points for look in tiles.looks))
        np.savez(
            file,
            format=FORMAT,
            centres=tiles.centres,
            buildings=tiles.buildings,
            tile_size=tiles.tile_size,
            source=tiles.source,
            points_a=points_a,
            offsets_a=offsets_a,
            points_b=points_b,
            offsets_b=offsets_b,
            points_looks=points_looks,
            offsets_looks=offsets_looks,
            looks=np.array(
                [(look.tile, look.changed, look.rebuilt) for look in tiles.looks], dtype=np.int32
            ).reshape(-1, 3),
        )


def load_tiles(path: Path) -> TileSet:
    """Read what `save_tiles` wrote. Raises ValueError for a file of another format."""
    with np.load(path, allow_pickle=False) as file:
        if "format" not in file or int(file["format"]) != FORMAT:
            raise ValueError(f"{path} is no training set of format {FORMAT}; build it again")
        size = file["tile_size"].astype(float).tolist()
        return TileSet(
            points_a=_unpacked(file["points_a"], file["offsets_a"]),
            points_b=_unpacked(file["points_b"], file["offsets_b"]),
            looks=_looks(file["looks"], _unpacked(file["points_looks"], file["offsets_looks"])),
            centres=file["centres"].astype(np.float64),
            buildings=file["buildings"].astype(np.int32),
            tile_size=(size[0], size[1], size[2]),
            source=str(file["source"]),
        )


def joined(parts: Sequence[TileSet], *, source: str) -> TileSet:
    """The tiles of several sets in one, each set a building of its own. Raises ValueError for none."""
    if not parts:
        raise ValueError("a training set needs a building")
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    return TileSet(
        points_a=tuple(points for part in parts for points in part.points_a),
        points_b=tuple(points for part in parts for points in part.points_b),
        looks=tuple(
            replace(look, tile=look.tile + start)
            for part, start in zip(parts, starts, strict=False)
            for look in part.looks
        ),
        centres=np.concatenate([part.centres for part in parts]),
        buildings=np.repeat(np.arange(len(parts), dtype=np.int32), [len(part) for part in parts]),
        tile_size=parts[0].tile_size,
        source=source,
    )


def split_tiles(tiles: TileSet, *, share: float = 0.1, seed: int = 42) -> tuple[TileSet, TileSet]:
    """Training and validation tiles (paper, Section 3.8: a spatial 90/10 split).

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


def _looks(rows: NDArray[np.int32], points: tuple[Points, ...]) -> tuple[Look, ...]:
    return tuple(
        Look(tile=tile, points=cloud, changed=bool(changed), rebuilt=bool(rebuilt))
        for (tile, changed, rebuilt), cloud in zip(rows.tolist(), points, strict=True)
    )


def _packed(clouds: tuple[Points, ...]) -> tuple[NDArray[np.float16], NDArray[np.int64]]:
    offsets = np.cumsum([0, *map(len, clouds)], dtype=np.int64)
    return np.concatenate([*clouds, np.empty((0, 3))]).astype(np.float16), offsets


def _unpacked(points: NDArray[np.float16], offsets: NDArray[np.int64]) -> tuple[Points, ...]:
    whole = points.astype(np.float32)
    return tuple(whole[start:end] for start, end in pairwise(offsets.tolist()))
