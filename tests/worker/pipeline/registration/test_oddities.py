"""What is told of scans that are odd, and that nothing is told of good ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.rooms import Room, as_scan
from worker.cloud.formats.scan import Scan, read_scan
from worker.cloud.types import Matrix4, Points
from worker.cloud.voxels import Voxels
from worker.pipeline.placement.variants import UP_AXES, turned
from worker.pipeline.registration.oddities import oddities
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.settings import RegistrationSettings
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

SETTINGS = RegistrationSettings()
GOOD = (
    "corridor_pair/cloud_0.ply",
    "corridor_pair/cloud_1.ply",
    "ipad_rooms/pix4d_database_560_db.ply",
    "ipad_rooms/pix4d_database_808_db.ply",
    "ipad_rooms/pix4d_user_560_user.ply",
    "ipad_rooms/pix4d_user_808_user.ply",
    "kinect_pairwise/capture0001.pcd",
    "kinect_pairwise/capture0002.pcd",
    "kinect_pairwise/capture0003.pcd",
    "kinect_pairwise/capture0004.pcd",
    "kinect_pairwise/capture0005.pcd",
    "room_scan/room_scan1.pcd",
    "room_scan/room_scan2.pcd",
)


def told(scan: Scan, prior: Matrix4 | None = None) -> dict[str, str]:
    found = oddities(scan, prepare(scan, SETTINGS), prior=prior)
    return {one.reason: one.detail for one in found}


@pytest.fixture(scope="module")
def hall() -> Scan:
    """The walls, floor and ceiling of a hall of 9 x 8 x 3 m, seen from 1.5 m above its floor."""
    rng = np.random.default_rng(5)
    sides = []
    for axis, half in enumerate((4.5, 4.0, 1.5)):
        for end in (-half, half):
            points = rng.uniform(-1, 1, (12_000, 3)) * (4.5, 4.0, 1.5)
            points[:, axis] = end
            sides.append(points)
    return as_scan(np.concatenate(sides).astype(np.float32), name="hall.pcd")


@pytest.mark.parametrize("file", GOOD)
def test_nothing_is_told_of_a_real_scan(shared_data: Path, file: str) -> None:
    assert told(read_scan(shared_data / file)) == {}


def test_nothing_is_told_of_simulated_scans(room: Room, hall: Scan) -> None:
    scans = [*room.before, *room.after, *visit(random_room(11), 1, seed=5)]
    assert [told(as_scan(scan.points)) for scan in scans] == [{}] * len(scans)
    assert told(hall) == {}


def test_points_that_were_left_out_are_told_with_count_and_distance(hall: Scan) -> None:
    detail = told(replace(hall, n_far=3, farthest=5_012.0))["far_points"]
    assert "3 points far from all others were left out, the farthest 5.0 km away" in detail
    missing = told(replace(hall, n_dropped=len(hall.points) * 4))
    assert "80% of its points (288000) are missing returns" in missing["missing_returns"]
    assert told(replace(hall, n_dropped=len(hall.points))) == {}  # half of them


def test_a_cell_of_a_voxel_filter_for_each_point_is_told(shared_data: Path) -> None:
    assert "a grid of 8.0 cm" in told(read_scan(shared_data / "floor/geb079_occ.ply"))["odd_density"]


def snapped(points: Points) -> Points:
    return np.unique(np.round(points / 0.05) * np.float32(0.05), axis=0)


def averaged(points: Points) -> Points:
    return Voxels.of(points, size=0.05).points


def tripled(points: Points) -> Points:
    return np.repeat(points, 3, axis=0)


@pytest.mark.parametrize(
    ("change", "said"),
    [(snapped, "a grid of 5.0 cm"), (tripled, "only 33% of its points are distinct"), (averaged, None)],
)
def test_points_on_a_grid_or_on_each_other_are_told(
    hall: Scan, change: Callable[[Points], Points], said: str | None
) -> None:
    found = told(replace(hall, points=change(hall.points)))
    assert ("odd_density" in found) == (said is not None)
    assert said is None or said in found["odd_density"]


def test_a_room_in_feet_times_ten_or_in_inches_is_told_to_be_high(hall: Scan) -> None:
    assert "118 m high" in told(replace(hall, points=hall.points / np.float32(0.0254)))["odd_size"]


@pytest.mark.parametrize("axis", [2, -2])
def test_y_up_is_told_of_a_hall_alone_and_not_where_the_prior_turns_it(hall: Scan, axis: int) -> None:
    file_from_map = UP_AXES[axis].T
    on_its_side = turned(hall, file_from_map)
    assert "along y, where most surfaces face, as if y pointed up" in told(on_its_side)["other_up_axis"]
    prior = np.eye(4)
    prior[:3, :3] = file_from_map.T
    assert told(on_its_side, prior) == {}


def test_a_tilted_scan_is_told(room: Room) -> None:
    angle = np.radians(35)
    tilt = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    assert "as of a tilted sensor" in told(turned(as_scan(room.after[0].points), tilt))["other_up_axis"]


def test_a_scan_far_from_where_its_sensor_stood_is_told(hall: Scan) -> None:
    moved = replace(hall, points=hall.points + np.array([3_000, 400, 0], np.float32))
    assert "its points lie 3.0 km from where its file says" in told(moved)["far_from_origin"]
    pose = np.eye(4)
    pose[:3, 3] = 3_000, 400, 0
    assert told(replace(moved, sensor_pose=pose)) == {}


def test_few_directions_rings_and_surfaces_are_told(hall: Scan) -> None:
    azimuth = np.degrees(np.arctan2(hall.points[:, 1], hall.points[:, 0]))
    narrow = replace(hall, points=hall.points[np.abs(azimuth - 42) < 15])
    assert "degrees about the vertical" in told(narrow)["little_coverage"]


def test_one_ring_of_a_sensor_is_told_to_be_little(hall: Scan) -> None:
    height = np.degrees(np.arctan2(hall.points[:, 2], np.hypot(hall.points[:, 0], hall.points[:, 1])))
    ring = replace(hall, points=hall.points[(height > -3.9) & (height < -0.1)])
    assert "points at 2 heights alone" in told(ring)["little_coverage"]


def test_a_small_area_is_told_to_be_little(hall: Scan) -> None:
    rng = np.random.default_rng(7)
    corner = rng.uniform(0, 1.08, (30_000, 3))  # a floor and two walls, of 1.17 square metres each
    corner[np.arange(len(corner)), np.arange(len(corner)) % 3] = 0
    corner += (1.0, 1.0, -1.5)
    scan = replace(hall, points=corner.astype(np.float32))
    (found,) = oddities(scan, prepare(scan, SETTINGS))
    assert (found.reason, "square metres of surfaces" in found.detail) == ("little_coverage", True)
    assert found.numbers["area"] == pytest.approx(3 * 1.08**2, rel=0.1)


def test_a_scan_that_an_offset_was_taken_off_has_no_place_of_its_sensor_and_both_are_told(hall: Scan) -> None:
    moved = replace(hall, offset=np.array([412_300.0, 5_654_300.0, 100.0]), tells_sensor=False)
    assert prepare(moved, SETTINGS).origin is None  # though all points can be seen from the new origin
    found = {one.reason: one for one in oddities(moved, prepare(moved, SETTINGS))}
    assert set(found) == {"offset_taken_off", "no_sensor_place"}
    assert found["offset_taken_off"].numbers == {"x": 412_300, "y": 5_654_300, "z": 100}
    assert "(412300, 5654300, 100) m was taken off" in found["offset_taken_off"].detail


def test_of_a_format_that_tells_no_sensor_it_is_told_where_the_points_contradict_the_origin(
    hall: Scan,
) -> None:
    assert told(replace(hall, tells_sensor=False)) == {}
    outside = replace(hall, points=hall.points + np.array([20, 0, 0], np.float32))
    assert "no_sensor_place" not in told(outside)
    assert set(told(replace(outside, tells_sensor=False))) == {"no_sensor_place"}
