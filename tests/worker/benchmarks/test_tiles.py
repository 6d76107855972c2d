"""Points find their tiles, and pairs can be taken by themselves."""

from __future__ import annotations

import numpy as np

from worker.benchmarks.speed import resized
from worker.benchmarks.tiles import flat_cells, selected, tiles_of
from worker.cloud.tiling import TileGrid, TilePairs, Tiles

GRID = TileGrid(origin=np.array([70.0, 20.0, 0.0]), size=np.array([1.5, 1.5, 1.0]), shape=(3, 1, 1))
INDICES = np.array([[i, 0, 0] for i in range(3)], np.int32)


def made_pairs() -> TilePairs:
    """Three tiles whose clouds are told apart by their sizes; the second was not observed."""

    def clouds(*counts: int) -> tuple[np.ndarray, ...]:
        return tuple(np.zeros((count, 3), np.float32) for count in counts)

    return TilePairs(
        reference=Tiles(grid=GRID, indices=INDICES, points=clouds(100, 200, 500)),
        current=clouds(300, 0, 90),
        observed=np.array([True, False, True]),
    )


def test_points_lie_in_the_tile_whose_corner_is_below_them_and_those_outside_in_none():
    grown = TileGrid(origin=GRID.origin, size=GRID.size, shape=(4, 1, 1), lowest=(-1, 0, 0))
    points = np.array([[70.1, 20.1, 0.5], [73.1, 20.1, 0.5], [69.9, 20.1, 0.5], [70.1, 20.1, 1.5]])
    assert tiles_of(points, GRID).tolist() == [0, 2, -1, -1]
    assert tiles_of(points, grown).tolist() == [1, 3, 0, -1]
    assert flat_cells(INDICES, grown).tolist() == [1, 2, 3]


def test_chosen_pairs_keep_their_two_sides_together():
    chosen = selected(made_pairs(), np.array([2, 1]))
    assert [len(points) for points in chosen.reference.points] == [500, 200]
    assert [len(points) for points in chosen.current] == [90, 0]
    assert chosen.reference.indices[:, 0].tolist() == [2, 1]
    assert chosen.observed.tolist() == [True, False]


def test_pairs_are_taken_again_until_there_are_as_many_as_asked_for():
    more = resized(made_pairs(), 5)
    assert [len(points) for points in more.current] == [300, 90, 300, 90, 300]
    assert more.reference.indices[:, 0].tolist() == [0, 2, 0, 2, 0]
    assert more.observed.all()
