"""Grids and balls on points that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from worker.detectors.kpconv.pyramid import neighbours, pairs_numpy, pyramid, subsampled


def test_a_cell_keeps_the_barycentre_of_its_points():
    points = np.array([[0.01, 0.01, 0], [0.03, 0.05, 0], [0.11, 0, 0], [-0.01, 0, 0]], np.float32)
    kept = subsampled(points, 0.1)
    assert kept.dtype == np.float32
    expected = np.array([[-0.01, 0, 0], [0.02, 0.03, 0], [0.11, 0, 0]])
    assert kept == pytest.approx(expected, abs=1e-7)


def test_neighbours_lie_within_the_radius_and_are_sorted_by_their_centre():
    points = np.array([[0, 0, 0], [1, 0, 0], [2.1, 0, 0]], np.float32)
    found = neighbours(points[[1, 0]], points, 1.05)
    assert list(zip(found.centres.tolist(), found.points.tolist(), strict=True)) == [
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
    ]
    assert found.counts.tolist() == [2, 2]


def test_numpy_finds_the_neighbours_that_the_tree_finds():
    points = np.random.default_rng(0).normal(size=(150, 3)).astype(np.float32)
    found = neighbours(points[:40], points, 0.7)
    rows, columns = pairs_numpy(points[:40], points, 0.7)
    assert np.array_equal(found.centres, rows)
    assert np.array_equal(found.points, columns)


def test_levels_double_their_cells_and_neighbours_keep_to_them():
    rng = np.random.default_rng(1)
    clouds = [(rng.uniform(-0.5, 0.5, (n, 3)) * (1.5, 1.5, 0.05)).astype(np.float32) for n in (400, 90)]
    made = pyramid(clouds, cell=0.05, levels=3, reach=2.5)
    assert len(made.points[0]) == 490
    assert len(made.points) == len(made.within) == len(made.below) + 1 == 3
    assert sum(made.sizes) == len(made.points[-1])
    for level, (points, found) in enumerate(zip(made.points, made.within, strict=True)):
        away = np.linalg.norm(points[found.centres] - points[found.points], axis=1)
        assert away.max() <= 2.5 * 0.05 * 2**level + 1e-6
        assert found.counts.sum() == len(found.centres)
    for level, found in enumerate(made.below):
        assert len(found.counts) == len(made.points[level + 1])
        assert found.counts.min() >= 1
        assert found.points.max() < len(made.points[level])


def test_clouds_end_to_end_are_nobody_elses_neighbours():
    cloud = np.random.default_rng(2).uniform(-0.3, 0.3, (60, 3)).astype(np.float32)
    both, alone = (pyramid(clouds, cell=0.05, levels=2, reach=2.5) for clouds in ([cloud, cloud], [cloud]))
    assert np.array_equal(both.within[0].points[len(alone.within[0].points) :], alone.within[0].points + 60)
    coarse = len(alone.points[1])
    assert np.array_equal(
        both.below[0].centres[len(alone.below[0].centres) :], alone.below[0].centres + coarse
    )


def test_any_order_of_the_points_gives_the_same_pyramid():
    rng = np.random.default_rng(3)
    cloud = rng.uniform(-0.3, 0.3, (200, 3)).astype(np.float32)
    one, other = (
        pyramid([points], cell=0.05, levels=3, reach=2.5) for points in (cloud, cloud[rng.permutation(200)])
    )
    for here, there in zip(one.points, other.points, strict=True):
        assert np.array_equal(here, there)
    assert np.array_equal(one.below[1].points, other.below[1].points)
