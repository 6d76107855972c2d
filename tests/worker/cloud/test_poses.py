from __future__ import annotations

import numpy as np
import pytest

from tests.support.graphs import ring, shifted
from worker.cloud.poses import difference, exponential, fit_poses, inverse, rigid_fit, transformed


def test_exponential_of_a_quarter_turn_about_z_takes_x_to_y() -> None:
    pose = exponential(np.array([0, 0, np.pi / 2, 1, 2, 3.0]))
    assert transformed(np.array([[1.0, 0, 0]]), pose) == pytest.approx(np.array([[1.0, 3.0, 3.0]]))


def test_inverse_undoes_a_pose() -> None:
    pose = exponential(np.array([0.3, -0.2, 0.9, 4, -5, 6.0]))
    assert inverse(pose) @ pose == pytest.approx(np.eye(4), abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, np.pi / 2, 3.0])
def test_difference_is_metres_and_radians(angle: float) -> None:
    a = exponential(np.array([0.1, 0.2, 0.3, 1, 1, 1.0]))
    b = a @ exponential(np.array([0, angle, 0, 0, 0, 0.0]))
    b[:3, 3] += (0.03, 0.0, 0.04)
    assert difference(a, b) == pytest.approx((0.05, angle), abs=1e-12)


MOTION = exponential(np.array([0.02, -0.01, 1.9, 4.0, -7.0, 0.3]))


def test_fit_poses_undoes_a_known_motion() -> None:
    poses = list(ring(5).values())
    found = fit_poses(poses, [MOTION @ pose for pose in poses], arm=2.0)
    assert found == pytest.approx(MOTION, abs=1e-9)


def test_fit_poses_stays_a_rotation_where_the_scans_stand_on_one_line() -> None:
    """Places alone leave the turn about the line free; headings hold it."""
    poses = [shifted(2.0 * number) for number in range(4)]
    found = fit_poses(poses, [MOTION @ pose for pose in poses], arm=2.0)
    assert found == pytest.approx(MOTION, abs=1e-9)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_rigid_fit_is_a_rotation_though_a_mirror_image_would_fit_better() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    found = rigid_fit(points, points * (1, 1, -1))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_rigid_fit_brings_points_onto_points() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    assert rigid_fit(points, transformed(points, MOTION)) == pytest.approx(MOTION, abs=1e-9)
