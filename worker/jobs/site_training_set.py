"""A training set of one map: its own scans, parted in two, are two visits between which nothing changed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from worker.cloud.tiling import Tiles, TilingSettings, cut, pair_tiles
from worker.cloud.types import Points
from worker.cloud.voxels import Voxels
from worker.errors import TrainingFailed
from worker.pipeline.registration.results import RegisteredScan
from worker.training.dataset import TileSet, split_tiles

#: Of the map's tiles, held out in one region; the first that will do. The paper's is the first.
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)
MIN_TWICE_SEEN = 3  #: held-out tiles that both halves saw, for the threshold


def halves(scans: Iterable[RegisteredScan], *, voxel_size: float) -> tuple[Points, Points]:
    """Return two clouds (N, 3) in the map frame, of every other scan each; one scan is held at a time."""
    fused: list[Voxels | None] = [None, None]
    for number, scan in enumerate(scans):
        one, before = Voxels.of(scan.points, size=voxel_size), fused[number % 2]
        fused[number % 2] = one if before is None else before.merged(one)
    nothing = np.empty((0, 3), np.float32)
    first, second = (nothing if half is None else half.points for half in fused)
    return first, second


def training_set(
    tiles: Tiles, visits: tuple[Points, Points], *, settings: TilingSettings, source: str
) -> TileSet:
    """Pair the tiles that both visits saw well; any other tile of the map has one observation alone."""
    first, second = visits
    seen = _seen_twice(first, second, tiles, settings)
    middle = tiles.grid.centers(tiles.indices)
    pairs = [
        seen.get(tuple(index), (whole, whole[:0]))
        for index, whole in zip(tiles.indices.tolist(), tiles.points, strict=True)
    ]
    return TileSet(
        points_a=tuple(_about(a, centre) for (a, _), centre in zip(pairs, middle, strict=True)),
        points_b=tuple(_about(b, centre) for (_, b), centre in zip(pairs, middle, strict=True)),
        observations=(),
        centres=middle,
        buildings=np.zeros(len(pairs), np.int32),
        tile_size=settings.tile_size,
        source=source,
    )


def held_out_share(tiles: TileSet, *, min_separation: float) -> float:
    """Return the least share of tiles that is enough to validate on. Raises TrainingFailed with the numbers."""
    for share in SHARES:
        if len(tiles) < 2:
            break
        training, validation = split_tiles(tiles, share=share)
        if all(_has_two_places(part.centres, min_separation) for part in (training, validation)) and (
            _twice(training) >= MIN_TWICE_SEEN <= _twice(validation)
        ):
            return share
    raise TrainingFailed(
        f"the map has {len(tiles)} tiles, {_twice(tiles)} of them seen well by two of its scans; that is too little to "
        f"train on and to hold {MIN_TWICE_SEEN} out in a region {min_separation:g} m wide; add scans to the map"
    )


def _seen_twice(
    first: Points, second: Points, tiles: Tiles, settings: TilingSettings
) -> dict[tuple[int, ...], tuple[Points, Points]]:
    if not len(first) or not len(second):
        return {}
    reference = cut(first, tiles.grid, min_points=settings.min_points)
    pairs = pair_tiles(reference, second, settings=settings)
    return {
        tuple(reference.indices[row].tolist()): (reference.points[row], pairs.current[row])
        for row in np.flatnonzero(pairs.observed).tolist()
    }


def _about(points: Points, centre: NDArray[np.float64]) -> Points:
    return (points - centre).astype(np.float32)


def _twice(tiles: TileSet) -> int:
    return sum(len(points) > 0 for points in tiles.points_b)


def _has_two_places(centres: NDArray[np.float64], min_separation: float) -> bool:
    """Return whether any two tiles are far enough apart to be told as different places."""
    return any((np.linalg.norm(centres - one, axis=1) >= min_separation).any() for one in centres)
