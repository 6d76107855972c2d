from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room, as_scan
from worker.cloud.poses import transformed
from worker.cloud.voxels import Voxels
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.settings import RegistrationSettings
from worker.simulation.visits import merged

SETTINGS = RegistrationSettings()


@pytest.fixture(scope="module")
def ready(room: Room) -> PreparedScan:
    return prepare(as_scan(room.before[0].points, name="hall.pcd"), SETTINGS)


def test_a_scan_is_prepared_at_one_point_a_voxel_with_normals_towards_its_sensor(
    room: Room, ready: PreparedScan
) -> None:
    surface = ready.surface
    assert surface.points == pytest.approx(Voxels.of(room.before[0].points, size=0.05).points)
    assert surface.oriented.mean() > 0.99
    towards = np.einsum("ij,ij->i", surface.normals, -surface.points)
    assert (towards[surface.oriented] >= 0).mean() > 0.999
    assert ready.origin == pytest.approx(np.zeros(3))


def test_a_prepared_scan_comes_back_from_the_disk(ready: PreparedScan, tmp_path: Path) -> None:
    moved = replace(ready, sensor_pose=shifted(1.0, 2.0, yaw=0.3))
    moved.save(tmp_path / "0.npz")
    again = PreparedScan.load(tmp_path / "0.npz")
    assert again.name == "hall.pcd"
    assert again.sensor_pose.tolist() == moved.sensor_pose.tolist()
    assert again.surface.points == pytest.approx(ready.surface.points, abs=1e-6)
    assert again.surface.normals == pytest.approx(ready.surface.normals, abs=1e-6)
    assert again.surface.oriented.tolist() == ready.surface.oriented.tolist()
    assert again.image is not None
    assert ready.image is not None
    assert again.image.ranges == pytest.approx(ready.image.ranges, abs=1e-5)
    assert again.image.origin.tolist() == ready.image.origin.tolist()
    distance, index = again.surface.nearest(again.surface.points[:9])
    assert (distance.max(), index.tolist()) == (0.0, list(range(9)))
    assert [path.name for path in tmp_path.iterdir()] == ["0.npz"]


def test_a_scan_without_a_known_sensor_comes_back_without_one(ready: PreparedScan, tmp_path: Path) -> None:
    replace(ready, image=None).save(tmp_path / "0.npz")
    again = PreparedScan.load(tmp_path / "0.npz")
    assert again.image is None
    assert again.origin is None


def test_a_sensor_is_believed_where_the_file_says_it_stood(room: Room) -> None:
    file_from_sensor = shifted(3.0, -2.0, 1.0, yaw=0.7)
    points = transformed(room.before[0].points, file_from_sensor).astype(np.float32)
    ready = prepare(as_scan(points, sensor_pose=file_from_sensor), SETTINGS)
    assert ready.origin == pytest.approx([3.0, -2.0, 1.0])


def test_a_sensor_that_cannot_have_seen_all_points_is_not_believed(room: Room) -> None:
    ready = prepare(as_scan(merged(room.before)[::4]), SETTINGS)
    assert ready.origin is None
    assert not ready.surface.oriented.any()
