from __future__ import annotations

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import as_scan
from worker.cloud.poses import inverse, transformed
from worker.pipeline.placement.variants import UP_AXES, mirrored, part, scaled, turned, up_axis

POINTS = np.random.default_rng(0).uniform(-3, 3, (90, 3)).astype(np.float32)
SCAN = as_scan(POINTS, sensor_pose=shifted(1.0, 2.0, 0.5, yaw=0.7))


def test_a_scaled_scan_has_its_sensor_as_much_farther_from_zero() -> None:
    half = scaled(SCAN, 0.5)
    assert half.points == pytest.approx(POINTS / 2)
    assert half.sensor_pose[:3, 3] == pytest.approx([0.5, 1.0, 0.25])
    assert half.sensor_pose[:3, :3] == pytest.approx(SCAN.sensor_pose[:3, :3])


def test_a_mirrored_scan_mirrored_again_is_what_it_was_and_each_point_as_far_from_its_sensor() -> None:
    image = mirrored(SCAN)
    assert mirrored(image).points == pytest.approx(POINTS)
    assert np.linalg.norm(image.points - image.sensor_pose[:3, 3], axis=1) == pytest.approx(
        np.linalg.norm(POINTS - SCAN.sensor_pose[:3, 3], axis=1), abs=1e-5
    )


@pytest.mark.parametrize("number", UP_AXES)
def test_a_turned_scan_has_the_named_axis_up_and_is_the_same_to_its_sensor(number: int) -> None:
    turn = UP_AXES[number]
    up = np.zeros((1, 3), np.float32)
    up[0, abs(number) - 1] = np.sign(number)
    assert turned(as_scan(up), turn).points[0] == pytest.approx([0, 0, 1])
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert up_axis(turn) == number
    after = turned(SCAN, turn)
    assert transformed(after.points, inverse(after.sensor_pose)) == pytest.approx(
        transformed(POINTS, inverse(SCAN.sensor_pose)), abs=1e-5
    )


def test_an_upright_pose_has_z_up() -> None:
    assert up_axis(shifted(yaw=2.0)[:3, :3]) == 3


def test_parts_of_a_scan_are_spans_of_its_file() -> None:
    assert part(SCAN, 0.0, 1 / 3).points.tolist() == POINTS[:30].tolist()
    assert part(SCAN, 2 / 3, 1.0).points.tolist() == POINTS[60:].tolist()
