from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.poses import difference, exponential, inverse, transformed


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
