"""A hall of tiles in one row along x, with as many points in each as a test says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.cloud.types import Points
from worker.pipeline.results.changes import ChangeSet, TileState

SIZE = (1.5, 1.5, 1.0)  # metres, Table 3 of the paper
ORIGIN = (10.0, -3.0, 0.5)  # metres; not 0, so that a forgotten origin shows


def in_tile(i: int, j: int, k: int, count: int, *, seed: int = 0) -> Points:
    """(count, 3) points well inside the box of tile (i, j, k)."""
    inside = np.random.default_rng([seed, *(np.array([i, j, k]) % 1000 + 1)]).uniform(0.05, 0.95, (count, 3))
    return (np.array(ORIGIN) + (np.array([i, j, k]) + inside) * SIZE).astype(np.float32)


def grid_of(*shape: int) -> TileGrid:
    i, j, k = shape
    return TileGrid(origin=np.array(ORIGIN), size=np.array(SIZE), shape=(i, j, k))


def row_of(reference: Sequence[int], current: Sequence[int], *, observed: Sequence[bool]) -> TilePairs:
    """Tiles (0, 0, 0), (1, 0, 0), ... with these numbers of points."""
    return TilePairs(
        reference=Tiles(
            grid=grid_of(len(reference), 1, 1),
            indices=np.array([[i, 0, 0] for i in range(len(reference))], np.int32).reshape(-1, 3),
            points=tuple(in_tile(i, 0, 0, count) for i, count in enumerate(reference)),
        ),
        current=tuple(in_tile(i, 0, 0, count, seed=1) for i, count in enumerate(current)),
        observed=np.array(observed, bool),
    )


def four_states(threshold: float = 0.5) -> ChangeSet:
    """One tile of each state, in the order of their numbers: scores 0.25, 0.75, 0.875 and none."""
    return ChangeSet(
        pairs=row_of([600, 700, 800, 900], [610, 710, 810, 3], observed=[True, True, True, False]),
        probabilities=np.array(
            [(0.75, 0.25, 0.0), (0.25, 0.75, 0.0), (0.125, 0.125, 0.75), (np.nan,) * 3], np.float32
        ),
        states=np.array(list(TileState), np.uint8),
        threshold=threshold,
    )
