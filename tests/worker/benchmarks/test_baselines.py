"""Each baseline on three hand-made tiles: the same again, a box added, a part removed."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.baselines import (
    FAR,
    Baseline,
    CloudToCloudBaseline,
    M3c2,
    M3c2Approximation,
    m3c2_is_installed,
)
from worker.cloud.tiling import TilePairs, TilingSettings, cut, grid_over, pair_tiles
from worker.cloud.types import Points

SAME, ADDED, REMOVED, UNSEEN = range(4)
STEP = 0.05


def sheet(low: tuple[float, float, float], high: tuple[float, float, float]) -> Points:
    """Points every 5 cm on a flat box, its middle in the middle of the voxels."""
    axes = [np.arange(a, b + 1e-6, STEP) if b > a else np.array([a]) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32) + 0.025


def wall(tile: int) -> Points:
    """Floor and back wall of one tile, 1.5 m along x."""
    x = 1.5 * tile
    return np.concatenate(
        [sheet((x, 0, 0), (x + 1.45, 1.45, 0)), sheet((x, 1.45, 0.05), (x + 1.45, 1.45, 0.95))]
    )


@pytest.fixture(scope="module")
def pairs() -> TilePairs:
    """Four tiles side by side; the box of the second stands 40 cm before the wall, the third's middle is gone."""
    before = np.concatenate([wall(tile) for tile in range(4)])
    box = sheet((1.9, 1.0, 0.05), (2.5, 1.0, 0.6))
    third = wall(REMOVED)
    hole = (np.abs(third[:, 0] - 3.75) < 0.35) & (third[:, 2] > 0.1)
    after = np.concatenate([wall(SAME), wall(ADDED), box, third[~hole], wall(UNSEEN)[:100]])
    grid = grid_over(before, tile_size=(1.5, 1.5, 1.0), voxel_size=STEP)
    tiles = cut(before, grid, min_points=512)
    return pair_tiles(tiles, after, settings=TilingSettings())


METHODS = [CloudToCloudBaseline(), CloudToCloudBaseline(statistic="far"), M3c2Approximation(), M3c2()]


def scores_of(method: Baseline, pairs: TilePairs) -> np.ndarray:
    if isinstance(method, M3c2) and not m3c2_is_installed():
        pytest.skip("py4dgeo is not installed: pip install '.[evaluate]'")
    return method.score(pairs)


def test_the_tiles_are_as_they_were_made(pairs: TilePairs) -> None:
    assert pairs.reference.indices.tolist() == [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]
    assert pairs.observed.tolist() == [True, True, True, False]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_an_equal_tile_scores_nothing_and_an_unobserved_one_is_not_scored(
    method: Baseline, pairs: TilePairs
) -> None:
    found = scores_of(method, pairs)
    assert found[SAME] == pytest.approx(0.0, abs=1e-6)
    assert np.isnan(found[UNSEEN])


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_an_added_box_scores_above_an_equal_tile(method: Baseline, pairs: TilePairs) -> None:
    found = scores_of(method, pairs)
    assert found[ADDED] > found[SAME] + 0.005


@pytest.mark.parametrize(
    "method",
    [CloudToCloudBaseline(), CloudToCloudBaseline(statistic="far"), M3c2()],
    ids=lambda method: method.name,
)
def test_a_removed_part_scores_above_an_equal_tile(method: Baseline, pairs: TilePairs) -> None:
    found = scores_of(method, pairs)
    assert found[REMOVED] > found[SAME] + 0.005


def test_m3c2_approx_does_not_see_what_is_gone(pairs: TilePairs) -> None:
    """It measures from the current points alone, and those that are left lie where they lay."""
    assert M3c2Approximation().score(pairs)[REMOVED] == pytest.approx(0.0, abs=1e-6)


def test_the_share_of_far_points_is_that_of_the_hole_less_its_rim(pairs: TilePairs) -> None:
    third = wall(REMOVED)
    hole = (np.abs(third[:, 0] - 3.75) < 0.35) & (third[:, 2] > 0.1)
    left = third[~hole]
    apart = np.linalg.norm(third[hole][:, None] - left[None], axis=2).min(axis=1)
    expected = (apart > FAR).sum() / len(third)
    assert expected > 0.05
    assert CloudToCloudBaseline(statistic="far").score(pairs)[REMOVED] == pytest.approx(expected)


def test_the_mean_of_c2c_takes_the_worse_of_both_directions(pairs: TilePairs) -> None:
    """The box is 40 cm from the wall and up to 60 cm above the floor; seen from the reference nothing is missing."""
    current = pairs.current[ADDED]
    before = np.concatenate(pairs.reference.points)
    apart = np.linalg.norm(current[:, None] - before[None], axis=2).min(axis=1)
    assert CloudToCloudBaseline().score(pairs)[ADDED] == pytest.approx(apart.mean(), rel=1e-5)


def test_m3c2_counts_core_points_with_nothing_around_as_changed(pairs: TilePairs) -> None:
    found = scores_of(M3c2(every=1), pairs)
    third = wall(REMOVED)
    hole = (np.abs(third[:, 0] - 3.75) < 0.35) & (third[:, 2] > 0.1)
    assert 0.2 * hole.mean() < found[REMOVED] < 1.2 * hole.mean()
