"""The truth of a tile, for edits whose tiles are known beforehand."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.tiling import TileGrid
from worker.simulation.scenes import rigid
from worker.simulation.scenes.mesh import block, box
from worker.simulation.truth import KINDS, changed_tiles, true_changes

GRID = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(4, 3, 3))  # fills the bare room


def marked(truth) -> list[tuple[int, ...]]:
    return [tuple(index) for index in np.argwhere(truth.changed).tolist()]


def test_no_edit_marks_no_tile(bare_room):
    assert marked(changed_tiles(bare_room, bare_room, GRID)) == []


def test_a_box_added_in_the_middle_of_one_tile_marks_exactly_that_tile(bare_room):
    after, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    truth = changed_tiles(bare_room, after, GRID)
    assert marked(truth) == [(1, 2, 0)]
    assert truth.cells[1, 2, 0].nonzero()[0].tolist() == [KINDS.index("add")]
    assert not truth.cells[0, 0, 0].any()
    assert truth.of(np.array([[1, 2, 0], [1, 2, 1]], dtype=np.int32)).tolist() == [True, False]


def test_the_count_is_the_cells_of_the_box_that_are_clear_of_the_floor(bare_room):
    after, _ = bare_room.with_added("carton", block((2.01, 3.51, 0.0), (2.49, 3.99, 0.48)))
    cells = changed_tiles(bare_room, after, GRID).cells[1, 2, 0]
    # 10 x 10 cells on top, 36 around in each of 8 layers; the lowest 7.5 cm are too near the floor.
    assert cells.tolist() == [pytest.approx(100 + 36 * 8, abs=3), 0, 0]


def test_a_removed_box_marks_the_place_where_it_stood(bare_room):
    before, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    truth = changed_tiles(before, before.without("carton")[0], GRID)
    assert marked(truth) == [(1, 2, 0)]
    assert truth.cells[1, 2, 0].nonzero()[0].tolist() == [KINDS.index("remove")]


def test_a_moved_box_marks_both_places(bare_room):
    before, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    after, _ = before.shifted("carton", dx=1.5)
    truth = changed_tiles(before, after, GRID)
    assert marked(truth) == [(1, 2, 0), (2, 2, 0)]
    assert truth.cells[2, 2, 0].nonzero()[0].tolist() == [KINDS.index("move")]


def test_a_shift_within_the_tolerance_is_no_change(bare_room):
    before, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    after, _ = before.shifted("carton", dx=0.05)
    assert marked(changed_tiles(before, after, GRID)) == []


def test_a_thing_smaller_than_the_least_count_is_no_change(bare_room):
    after, _ = bare_room.with_added("mug", box(0.09, 0.09, 0.12).at(2.25, 3.75))
    assert marked(changed_tiles(bare_room, after, GRID)) == []
    assert marked(changed_tiles(bare_room, after, GRID, min_cells=1)) == [(1, 2, 0)]


def test_what_no_sensor_could_see_does_not_count(bare_room):
    screened, _ = bare_room.with_added("screen", block((3.0, 0.0, 0.0), (3.1, 4.5, 3.0)))
    after, _ = screened.with_added("carton", box(0.5, 0.5, 0.5).at(5.25, 0.75))
    near, far = rigid(1.0, 1.0, 0.35), rigid(4.0, 1.0, 0.35)
    assert marked(changed_tiles(screened, after, GRID, sensors_after=[near])) == []
    assert marked(changed_tiles(screened, after, GRID, sensors_after=[near, far])) == [(3, 0, 0)]
    assert marked(changed_tiles(screened, after, GRID)) == [(3, 0, 0)]


def test_changes_outside_the_grid_are_left_out(bare_room):
    after, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    elsewhere = TileGrid(origin=np.array([0.0, 0.0, 1.0]), size=GRID.size, shape=(4, 3, 2))
    assert marked(changed_tiles(bare_room, after, elsewhere)) == []


def test_a_tile_keeps_its_index_in_a_grid_that_grew_below_zero(bare_room):
    after, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    grown = TileGrid(origin=GRID.origin, size=GRID.size, shape=(6, 4, 3), lowest=(-2, -1, 0))
    truth = changed_tiles(bare_room, after, grown)
    assert marked(truth) == [(3, 3, 0)]
    indices = np.array([[1, 2, 0], [3, 2, 0], [-1, -1, 0]], np.int32)
    assert truth.of(indices).tolist() == [True, False, False]
    assert (
        truth.cells_of(indices)[0].tolist() == changed_tiles(bare_room, after, GRID).cells[1, 2, 0].tolist()
    )


def test_the_truth_follows_the_scene_into_the_frame_of_the_map(bare_room):
    after, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    map_from_world = rigid(10.0, 20.0, 1.0, yaw=90)  # the carton's middle goes to (6.25, 22.25, 1.25)
    grid = TileGrid(origin=np.array([5.5, 20.0, 1.0]), size=np.array([1.5, 1.5, 1.0]), shape=(3, 4, 3))
    near = map_from_world @ rigid(2.25, 2.0, 0.35)
    exists, visible = true_changes(
        bare_room, after, grid, map_from_world=map_from_world, first=[near], second=[near]
    )
    assert np.argwhere(exists.changed).tolist() == [[0, 1, 0]]
    assert np.argwhere(visible.changed).tolist() == [[0, 1, 0]]
    assert visible.cells.sum() < exists.cells.sum()  # not the side that is turned away


def test_a_change_behind_a_screen_exists_and_is_in_nobodys_sight(bare_room):
    screened, _ = bare_room.with_added("screen", box(0.1, 4.5, 3.0).at(3.05, 2.25))
    after, _ = screened.with_added("carton", box(0.5, 0.5, 0.5).at(5.25, 0.75))
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(4, 3, 3))
    sensors = [rigid(1.0, 1.0, 0.35)]
    exists, visible = true_changes(
        screened, after, grid, map_from_world=np.eye(4), first=sensors, second=sensors
    )
    assert np.argwhere(exists.changed).tolist() == [[3, 0, 0]]
    assert not visible.changed.any()
