"""A patch is its distinct points and their repeats; padding is only how the paper writes it down."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from worker.cloud.patches import farthest_points, patch


@pytest.fixture
def cloud() -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.5, 0.5, (300, 3)).astype(np.float32)


@pytest.fixture
def without_fpsample(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "fpsample", None)  # importing it now fails


def test_a_small_tile_keeps_every_point_and_repeats_them_evenly(cloud):
    made = patch(cloud, size=1000, seed=42)
    assert made.repeats.sum() == 1000
    assert set(made.repeats.tolist()) == {3, 4}  # 1000 = 3 x 300 + 100
    assert sorted(map(tuple, made.distinct)) == sorted(map(tuple, cloud))


def test_the_padded_patch_holds_each_point_as_often_as_its_repeats_say(cloud):
    made = patch(cloud, size=1000, seed=42)
    rows, counts = np.unique(made.padded(), axis=0, return_counts=True)
    expected = dict(zip(map(tuple, made.distinct), made.repeats.tolist(), strict=True))
    assert {tuple(row): count for row, count in zip(rows, counts.tolist(), strict=True)} == expected


def test_the_centroid_is_that_of_the_padded_patch_not_of_the_distinct_points():
    two = np.array([[0, 0, 0], [3, 0, 0]], dtype=np.float32)
    made = patch(two, size=3, seed=0)
    assert made.centroid == pytest.approx(made.padded().mean(axis=0))
    assert made.centroid[0] in (pytest.approx(1.0), pytest.approx(2.0))


def test_the_same_seed_gives_the_same_patch_and_another_seed_another_order(cloud):
    first, again, other = (patch(cloud, size=1000, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.padded(), again.padded())
    assert not np.array_equal(first.distinct, other.distinct)


def test_a_large_tile_is_cut_to_distinct_points_by_farthest_point_sampling(cloud):
    made = patch(cloud, size=64, seed=42)
    assert len(np.unique(made.distinct, axis=0)) == 64
    assert np.array_equal(made.repeats, np.ones(64))


def test_farthest_points_of_a_row_are_its_ends_then_its_middle(without_fpsample):
    row = np.zeros((11, 3), dtype=np.float32)
    row[:, 0] = np.arange(11)
    assert farthest_points(row, 3, start=0).tolist() == [0, 10, 5]


def test_fpsample_goes_on_from_its_first_point_as_plain_numpy_does(cloud, request):
    fast = farthest_points(cloud, 50, start=7)
    request.getfixturevalue("without_fpsample")
    assert np.array_equal(farthest_points(cloud, 50, start=int(fast[0])), fast)


def test_an_empty_cloud_is_refused():
    with pytest.raises(ValueError, match="at least one point"):
        patch(np.empty((0, 3), dtype=np.float32), size=10, seed=0)
