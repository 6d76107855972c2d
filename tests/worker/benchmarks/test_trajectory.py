"""Frames are undone, errors are not, and a wrong pose bends nobody else's."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.trajectory import ARM, align, distances
from worker.cloud.poses import fit_poses, inverse
from worker.cloud.types import Matrix4
from worker.simulation.scenes import rigid

MAP_FROM_WORLD = rigid(12.0, -7.0, 1.5, yaw=140.0, pitch=3.0, roll=-2.0)


@pytest.fixture
def walk() -> list[Matrix4]:
    """Twenty poses on an L of 30 m, in the world."""
    rng = np.random.default_rng(0)
    places = [(2.0 * step, 0.0) for step in range(10)] + [(18.0, 2.0 * step) for step in range(10)]
    return [rigid(x, y, 0.35, yaw=float(rng.uniform(0, 360)), pitch=0.5) for x, y in places]


def test_a_known_rigid_motion_is_undone(walk: list[Matrix4]) -> None:
    true_from_map = align([MAP_FROM_WORLD @ pose for pose in walk], walk)
    np.testing.assert_allclose(true_from_map, inverse(MAP_FROM_WORLD), atol=1e-9)


def test_one_pose_20_metres_off_keeps_its_error_and_leaves_the_rest_at_none(walk: list[Matrix4]) -> None:
    estimated = [MAP_FROM_WORLD @ pose for pose in walk]
    estimated[4] = rigid(0.0, 20.0, 0.0) @ estimated[4]
    off = distances(align(estimated, walk), estimated, walk)
    assert off[4] == pytest.approx(20.0)
    assert np.delete(off, 4).max() < 1e-9
    assert distances(fit_poses(estimated, walk, arm=ARM), estimated, walk)[0] > 0.3  # one fit over all


def test_wrong_poses_short_of_half_are_told_from_the_right_ones(walk: list[Matrix4]) -> None:
    estimated = [MAP_FROM_WORLD @ pose for pose in walk]
    wrong = range(12, 20)  # eight that agree with each other: a stretch of corridor closed a wrong loop
    for scan in wrong:
        estimated[scan] = estimated[scan] @ rigid(0.0, 0.0, 3.0)
    off = distances(align(estimated, walk), estimated, walk)
    assert (np.flatnonzero(off > 0.1) == list(wrong)).all()


def test_noise_is_averaged_over_all_scans_that_agree(walk: list[Matrix4]) -> None:
    rng = np.random.default_rng(1)
    estimated = [MAP_FROM_WORLD @ pose @ rigid(*rng.normal(0.0, 0.01, 3).tolist()) for pose in walk]
    fits = (fit_poses(estimated, walk, arm=ARM), align(estimated, walk))
    best, robust = (distances(fit, estimated, walk) for fit in fits)
    np.testing.assert_allclose(robust, best, atol=1e-9)  # nobody is an outlier
    assert robust.mean() < 0.02


def test_stops_on_one_line_leave_no_roll_free() -> None:
    line = [rigid(float(x), 0.0, 0.35, yaw=10.0) for x in range(4)]
    true_from_map = align([MAP_FROM_WORLD @ pose for pose in line], line)
    np.testing.assert_allclose(true_from_map, inverse(MAP_FROM_WORLD), atol=1e-9)


def test_no_poses_are_refused() -> None:
    with pytest.raises(ValueError, match="0 poses"):
        align([], [])
