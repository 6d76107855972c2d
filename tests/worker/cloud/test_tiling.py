from __future__ import annotations

import numpy as np
import pytest

from tests.support.tilings import ORIGIN, SIZE, grid_of, in_tile
from worker.cloud import tiling as module
from worker.cloud.tiling import (
    TileGrid,
    TilePairs,
    Tiles,
    TilingSettings,
    cut,
    grid_over,
    grown,
    pair_tiles,
    tile_id,
)
from worker.errors import MapFailed

SETTINGS = TilingSettings()


def test_defaults_are_those_of_table_3() -> None:
    assert SETTINGS.tile_size == (1.5, 1.5, 1.0)
    assert SETTINGS.min_points == 512


def test_tile_id_is_three_zero_padded_indices() -> None:
    assert tile_id(np.array([1, 23, 456], np.int32)) == "tile_001_023_456"
    assert tile_id(np.array([1234, 0, 7], np.int32)) == "tile_1234_000_007"


@pytest.mark.parametrize("voxel", [0.05, 0.1, 0.04])
@pytest.mark.parametrize("corner", [(0.12, -0.12, 7.0), (-3.01, 0.0, 0.049), (2.0, -0.26, -11.99)])
def test_the_grid_starts_on_a_voxel_at_most_one_below_the_corner(
    voxel: float, corner: tuple[float, ...]
) -> None:
    lowest = np.array(corner, np.float32)
    grid = grid_over(np.array([lowest, lowest + 2], np.float32), tile_size=SIZE, voxel_size=voxel)
    assert grid.origin / voxel == pytest.approx(np.rint(grid.origin / voxel), abs=1e-9)
    assert np.all(grid.origin <= lowest)
    assert np.all(lowest - grid.origin < voxel)


@pytest.mark.parametrize(
    ("extent", "shape"),
    [
        ((1.4, 1.4, 0.9), (1, 1, 1)),
        ((1.5, 1.5, 1.0), (2, 2, 2)),  # the last point lies on a border: it opens the next tile
        ((4.6, 1.0, 2.1), (4, 1, 3)),
    ],
)
def test_the_grid_holds_the_highest_point(extent: tuple[float, ...], shape: tuple[int, ...]) -> None:
    corners = np.array([(0, 0, 0), extent], np.float32)
    grid = grid_over(corners, tile_size=SIZE, voxel_size=0.05)
    assert grid.shape == shape
    assert sum(len(points) for points in cut(corners, grid, min_points=1).points) == 2


def test_one_point_makes_a_grid_of_one_tile() -> None:
    assert grid_over(np.full((1, 3), 3.33, np.float32), tile_size=SIZE, voxel_size=0.05).shape == (1, 1, 1)


def test_a_stray_point_60_km_away_is_refused_with_the_extent() -> None:
    points = np.array([(0, 0, 0), (60_000, 9_000, 0)], np.float32)
    with pytest.raises(MapFailed, match=r"6000\d x 900\d x 1 m; remove stray points"):
        grid_over(points, tile_size=SIZE, voxel_size=0.05)


def test_lower_and_centre_of_tile_2_1_3() -> None:
    index = np.array([[2, 1, 3]], np.int32)
    grid = grid_of(5, 5, 5)
    assert grid.lower(index).tolist() == [[13.0, -1.5, 3.5]]
    assert grid.centers(index).tolist() == [[13.75, -0.75, 4.0]]


def test_a_point_on_a_border_belongs_to_the_upper_tile() -> None:
    border = np.add(ORIGIN, (1.5, 0.7, 0.5))
    below = border - (0.001, 0, 0)
    tiles = cut(np.array([border, below], np.float32), grid_of(2, 1, 1), min_points=1)
    assert tiles.indices.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert tiles.points[0] == pytest.approx(below[None], abs=1e-5)
    assert tiles.points[1] == pytest.approx(border[None], abs=1e-5)


def test_a_tile_of_512_points_is_kept_and_one_of_511_left_out() -> None:
    points = np.concatenate([in_tile(0, 0, 0, 511), in_tile(1, 0, 0, 512)])
    tiles = cut(points, grid_of(2, 1, 1), min_points=512)
    assert tiles.indices.tolist() == [[1, 0, 0]]
    assert len(tiles.points[0]) == 512


def test_tiles_hold_each_point_once_in_the_order_of_the_grid() -> None:
    cells = [(1, 1, 0), (0, 0, 1), (1, 0, 0), (0, 2, 1)]
    parts = {cell: in_tile(*cell, 20 + n) for n, cell in enumerate(cells)}
    mixed = np.random.default_rng(0).permutation(np.concatenate(list(parts.values())))
    tiles = cut(mixed, grid_of(2, 3, 2), min_points=1)
    assert tiles.indices.tolist() == sorted(map(list, cells))
    for index, points in zip(tiles.indices, tiles.points, strict=True):
        expected = parts[tuple(index.tolist())]
        assert sorted(points.tolist()) == sorted(expected.tolist())


def test_no_point_makes_no_tile() -> None:
    tiles = cut(np.empty((0, 3), np.float32), grid_of(2, 2, 2), min_points=1)
    assert tiles.points == ()
    assert tiles.indices.shape == (0, 3)


def test_pairs_hold_the_points_of_the_same_box() -> None:
    reference = cut(
        np.concatenate([in_tile(i, 0, 0, 600) for i in range(3)]), grid_of(3, 1, 1), min_points=512
    )
    seen = {0: in_tile(0, 0, 0, 550, seed=1), 2: in_tile(2, 0, 0, 580, seed=1)}
    pairs = pair_tiles(reference, np.concatenate([seen[2], seen[0]]), settings=SETTINGS)
    assert pairs.current[0].tolist() == seen[0].tolist()
    assert pairs.current[1].shape == (0, 3)
    assert pairs.current[2].tolist() == seen[2].tolist()
    assert pairs.observed.tolist() == [True, False, True]


def test_points_outside_the_grid_or_outside_kept_tiles_are_ignored() -> None:
    reference = cut(
        np.concatenate([in_tile(0, 0, 0, 600), in_tile(1, 0, 0, 5)]), grid_of(2, 1, 1), min_points=512
    )
    outside = [in_tile(*cell, 50) for cell in [(-1, 0, 0), (2, 0, 0), (0, 1, 0), (0, 0, -1), (1, 0, 0)]]
    pairs = pair_tiles(reference, np.concatenate([*outside, in_tile(0, 0, 0, 7)]), settings=SETTINGS)
    assert [len(points) for points in pairs.current] == [7]


def test_a_survey_of_no_point_observed_nothing() -> None:
    reference = cut(in_tile(0, 0, 0, 600), grid_of(1, 1, 1), min_points=512)
    pairs = pair_tiles(reference, np.empty((0, 3), np.float32), settings=SETTINGS)
    assert [len(points) for points in pairs.current] == [0]
    assert pairs.observed.tolist() == [False]


def test_pairs_of_no_tile_are_none() -> None:
    reference = cut(in_tile(0, 0, 0, 5), grid_of(1, 1, 1), min_points=512)
    pairs = pair_tiles(reference, in_tile(0, 0, 0, 600), settings=SETTINGS)
    assert pairs.current == ()
    assert pairs.observed.shape == (0,)


@pytest.mark.parametrize(
    ("n_reference", "n_current", "observed"),
    [
        (600, 511, False),  # one short of min_points
        (600, 512, True),
        (1024, 512, True),  # exactly half of the reference
        (1025, 512, False),
        (4000, 1999, False),
        (4000, 2000, True),
    ],
)
def test_a_tile_is_observed_with_512_points_and_half_of_the_reference(
    n_reference: int, n_current: int, observed: bool
) -> None:
    reference = cut(in_tile(0, 0, 0, n_reference), grid_of(1, 1, 1), min_points=512)
    pairs = pair_tiles(reference, in_tile(0, 0, 0, n_current, seed=1), settings=SETTINGS)
    assert pairs.observed.tolist() == [observed]


def test_a_share_of_0_leaves_only_the_number_of_points() -> None:
    reference = cut(in_tile(0, 0, 0, 4000), grid_of(1, 1, 1), min_points=512)
    settings = SETTINGS.model_copy(update={"min_observed_share": 0.0})
    assert pair_tiles(reference, in_tile(0, 0, 0, 512), settings=settings).observed.tolist() == [True]


def test_a_grid_that_grows_keeps_its_origin_and_the_index_of_every_tile() -> None:
    before = np.concatenate([in_tile(i, 0, 0, 20) for i in range(2)])
    more = np.concatenate([in_tile(-3, 0, 0, 20), in_tile(1, 2, -1, 20)])
    grid = grid_of(2, 1, 1)
    wider = grown(grid, np.concatenate([before, more]))
    assert wider.origin.tolist() == grid.origin.tolist()
    assert (wider.lowest, wider.shape) == ((-3, 0, -1), (5, 3, 2))
    tiles = cut(np.concatenate([before, more]), wider, min_points=1)
    assert tiles.indices.tolist() == [[-3, 0, 0], [0, 0, 0], [1, 0, 0], [1, 2, -1]]
    assert wider.lower(tiles.indices)[0] == pytest.approx(np.add(ORIGIN, (-4.5, 0, 0)))
    old = cut(before, grid, min_points=1)
    assert [part.tolist() for part in old.points] == [part.tolist() for part in tiles.points[1:3]]


def test_a_grid_that_grew_into_nothing_shrinks_around_the_points_and_keeps_the_indices() -> None:
    narrow = grown(grid_of(9, 9, 9), in_tile(4, 5, 6, 10))
    assert (narrow.lowest, narrow.shape) == ((4, 5, 6), (1, 1, 1))
    assert cut(in_tile(4, 5, 6, 10), narrow, min_points=1).indices.tolist() == [[4, 5, 6]]


def test_pairs_of_a_grid_below_zero_hold_the_points_of_the_same_box() -> None:
    points = np.concatenate([in_tile(i, 0, 0, 600) for i in (-2, -1, 1)])
    reference = cut(points, grown(grid_of(1, 1, 1), points), min_points=512)
    seen = {i: in_tile(i, 0, 0, 550 + i, seed=1) for i in (-2, 1, 5)}
    pairs = pair_tiles(reference, np.concatenate(list(seen.values())), settings=SETTINGS)
    assert [part.tolist() for part in pairs.current] == [seen[-2].tolist(), [], seen[1].tolist()]


def test_a_point_is_located_in_one_of_the_tiles_beside_them_or_beyond_the_grid() -> None:
    cells = [(-1, 0, 0), (0, 0, 0), (1, 0, 0), (0, 3, 0)]
    points = np.concatenate([in_tile(*cell, 5) for cell in cells])
    grid = grown(grid_of(2, 1, 1), points[:15])
    assert grid.locate(points).tolist() == [0] * 5 + [1] * 5 + [2] * 5 + [-1] * 5
    assert grid.cells(np.array(cells, np.int32)).tolist() == [0, 1, 2, -1]
    wanted = np.array([[1, 0, 0], [7, 7, 7], [-1, 0, 0]], np.int32)
    rows = grid.locate_among(points, wanted)
    assert rows.tolist() == [2] * 5 + [-1] * 5 + [0] * 5 + [-1] * 5
    assert (grid.locate_among(points, np.empty((0, 3), np.int32)) == -1).all()
    assert grid.locate_among(points[:0], wanted).shape == (0,)


def test_chosen_pairs_keep_their_two_sides_together() -> None:
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(3, 1, 1))
    clouds = tuple(np.zeros((count, 3), np.float32) for count in (100, 200, 500, 300, 0, 90))
    indices = np.array([[i, 0, 0] for i in range(3)], np.int32)
    reference = Tiles(grid=grid, indices=indices, points=clouds[:3])
    pairs = TilePairs(reference=reference, current=clouds[3:], observed=np.array([True, False, True]))
    chosen = pairs.subset(np.array([2, 1]))
    assert [len(points) for points in chosen.reference.points] == [500, 200]
    assert [len(points) for points in chosen.current] == [90, 0]
    assert chosen.reference.indices[:, 0].tolist() == [2, 1]
    assert chosen.observed.tolist() == [True, False]


def test_points_of_a_large_cloud_are_located_some_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(-1, 9, (500, 3)).astype(np.float32) + np.array(
        ORIGIN, np.float32
    )
    grid = grid_of(4, 4, 4)
    whole = grid.locate(points)
    monkeypatch.setattr(module, "_AT_ONCE", 64)
    assert np.array_equal(grid.locate(points), whole)


def test_nobody_who_shares_a_grid_can_change_it() -> None:
    size = np.array(SIZE)
    grid = TileGrid(origin=np.zeros(3), size=size, shape=(1, 1, 1))
    for array in (grid.origin, grid.size):
        with pytest.raises(ValueError, match="read-only"):
            np.multiply(array, 2, out=array)
    assert size.flags.writeable  # it is the grid's that cannot be written to, not the caller's
