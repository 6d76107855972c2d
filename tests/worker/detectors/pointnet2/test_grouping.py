"""Set abstraction's groups, on points that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from worker.detectors.pointnet2.grouping import Level, ball_query, grouped, nearest_numpy

#: On a line, metres.
LINE = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 0, 0]], np.float32)


def test_a_ball_with_fewer_points_than_asked_for_repeats_its_nearest():
    rows = ball_query(LINE, LINE[[0, 2, 3]], 1.5, 3)
    assert rows[0].tolist() == [0, 1, 0]
    assert rows[1, 0] == 2
    assert sorted(rows[1].tolist()) == [1, 2, 2]
    assert rows[2].tolist() == [3, 3, 3]


def test_more_neighbours_than_there_are_points_repeat_the_nearest_too():
    assert ball_query(LINE, LINE[[0]], 10.0, 6).tolist() == [[0, 1, 2, 3, 0, 0]]


def test_of_more_points_than_asked_for_the_nearest_are_taken():
    assert ball_query(LINE, LINE[[1]], 10.0, 1).tolist() == [[1]]
    assert set(ball_query(LINE, LINE[[3]], 10.0, 2)[0].tolist()) == {2, 3}


def test_numpy_finds_the_neighbours_that_the_tree_finds():
    points = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    with_tree = ball_query(points, points[:50], 0.6, 16)
    distances, rows = nearest_numpy(points, points[:50], 0.6, 16)
    assert np.array_equal(np.where(np.isinf(distances), rows[:, :1], rows), with_tree)


def test_centres_are_farthest_points_and_each_level_takes_the_first_of_the_one_below():
    levels = (
        Level(centres=3, radius=1.1, neighbours=2, widths=(8,)),
        Level(centres=2, radius=9.0, neighbours=2, widths=(8,)),
    )
    line = np.arange(20, dtype=np.float32)[:, None] * (1, 0, 0)
    clouds = grouped([line[::-1].astype(np.float32)], levels)
    assert clouds.points[:, 0].tolist() == list(range(20))
    chosen = clouds.points[clouds.levels[0].centres]
    # wherever it begins, both ends are among three farthest points of the line
    assert {0.0, 19.0} <= set(chosen[:, 0].tolist())
    assert clouds.levels[1].centres.tolist() == [0, 1]
    assert clouds.sizes == [2]


def test_a_small_cloud_has_each_point_for_a_centre():
    (level,) = grouped([LINE], (Level(centres=9, radius=0.5, neighbours=4, widths=(8,)),)).levels
    assert level.centres.tolist() == [0, 1, 2, 3]
    assert (level.neighbours == level.centres[:, None]).all()


def test_clouds_end_to_end_have_the_rows_of_their_own():
    rng = np.random.default_rng(3)
    first, second = (rng.normal(size=(n, 3)).astype(np.float32) for n in (40, 25))
    levels = (
        Level(centres=10, radius=1.0, neighbours=5, widths=(8,)),
        Level(centres=4, radius=2.0, neighbours=3, widths=(8,)),
    )
    both, alone = grouped([first, second], levels), grouped([second], levels)
    assert both.sizes == [4, 4]
    for level, below, centres in zip((0, 1), (40, 10), (10, 4), strict=True):
        assert np.array_equal(both.levels[level].neighbours[centres:], alone.levels[level].neighbours + below)
        assert np.array_equal(both.levels[level].centres[centres:], alone.levels[level].centres + below)


@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_any_order_of_the_points_gives_the_same_groups(shift: float):
    rng = np.random.default_rng(4)
    cloud = (rng.normal(size=(300, 3)) + shift).astype(np.float32)
    levels = (Level(centres=30, radius=0.8, neighbours=8, widths=(8,)),)
    one, other = (grouped([points], levels) for points in (cloud, cloud[rng.permutation(300)]))
    assert np.array_equal(one.points, other.points)
    assert np.array_equal(one.levels[0].neighbours, other.levels[0].neighbours)
