"""Inliers on a floor of 2 x 2 m with a point every 5 cm; free space before walls and in a room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room, as_scan, wall
from worker.cloud.poses import exponential, inverse
from worker.cloud.visibility import RangeImage
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import (
    ROBOT,
    TwoWayInliers,
    free_space_violation,
    require_accepted,
    two_way_inliers,
)

SETTINGS = RegistrationSettings()


def floor(*, up: float = 1.0, oriented: bool = True, extra: np.ndarray | None = None) -> Surface:
    x, y = np.meshgrid(np.arange(0, 2, 0.05), np.arange(0, 2, 0.05))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    if extra is not None:
        points = np.concatenate([points, extra])
    return Surface.of(points, np.tile([0, 0, up], (len(points), 1)), np.full(len(points), oriented))


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return exponential(np.array([0, 0, 0, x, y, z]))


def compared(source: Surface, target: Surface, pose: np.ndarray | None = None) -> TwoWayInliers:
    pose = np.eye(4) if pose is None else pose
    return two_way_inliers(source, target, pose, surface_distance=0.05)


@pytest.mark.parametrize(
    ("lift", "overlap", "on_surface"),
    [(0.0, 1.0, 1.0), (0.04, 1.0, 1.0), (0.06, 1.0, 0.0), (-0.06, 1.0, 0.0), (0.31, 0.0, 0.0)],
)
def test_a_floor_lifted_off_the_map(lift: float, overlap: float, on_surface: float) -> None:
    found = compared(floor(), floor(), moved(z=lift))
    assert (found.overlap, found.forward, found.backward) == (overlap, on_surface, on_surface)


def test_a_floor_shifted_by_half_its_length_agrees_where_both_have_something() -> None:
    found = compared(floor(), floor(), moved(x=1.0))
    assert found.overlap == pytest.approx((20 + 5.5) / 40, abs=0.026)  # half, and 30 cm beyond the edge
    assert (found.forward, found.backward) == (1.0, 1.0)


def test_the_other_side_of_a_floor_is_not_seen_by_the_map() -> None:
    assert compared(floor(up=-1.0), floor()).overlap == 0.0


def test_a_floor_seen_from_nowhere_known_agrees_with_both_sides() -> None:
    assert compared(floor(up=-1.0, oriented=False), floor()).ratio == 1.0


def test_a_board_in_the_scan_alone_disagrees_forward_and_in_the_map_alone_backward() -> None:
    x, y = np.meshgrid(np.arange(0, 1, 0.05), np.arange(0, 1, 0.05))
    board = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.2)])  # 400 points over 1600
    scan_has_it = compared(floor(extra=board), floor())
    assert (scan_has_it.forward, scan_has_it.backward) == (0.8, 1.0)
    map_has_it = compared(floor(), floor(extra=board))
    assert (map_has_it.forward, map_has_it.backward) == (1.0, 0.8)
    assert scan_has_it.ratio == map_has_it.ratio == 0.8


def test_the_pose_is_target_from_source() -> None:
    """A quarter turn and a shift that lay the floor on a map three metres away; the inverse does not."""
    away = floor()
    away = Surface.of(away.points + np.array([[3.0, 0, 0]]), away.normals, away.oriented)
    pose = exponential(np.array([0, 0, np.pi / 2, 4.95, 0, 0]))
    there = compared(floor(), away, pose)
    assert (there.overlap, there.ratio) == (1.0, 1.0)
    assert compared(away, floor(), pose).overlap == 0.0


def test_the_ratio_is_that_of_the_worse_direction() -> None:
    assert TwoWayInliers(overlap=0.5, forward=0.9, backward=0.6).ratio == 0.6
    assert TwoWayInliers(overlap=0.5, forward=0.6, backward=0.9).ratio == 0.6


# free space


def posts(x: float) -> PreparedScan:
    """A scan of 50 points that stand `x` metres before its sensor, and of nothing else."""
    points = np.column_stack([np.full(50, x), np.linspace(-0.2, 0.2, 50), np.zeros(50)])
    surface = Surface.of(points, np.tile([-1.0, 0, 0], (50, 1)), np.ones(50, bool))
    image = RangeImage(origin=np.zeros(3), ranges=RangeImage.of(points, np.zeros(3)).ranges)
    return PreparedScan(name="posts", surface=surface, image=image, sensor_pose=np.eye(4))


def seeing(x: float) -> PreparedScan:
    """A scan that saw a wall at `x` metres from the same place."""
    other = posts(x)
    return replace(other, image=RangeImage.of(wall(x), np.zeros(3)))


def test_what_is_near_the_robot_is_not_asked() -> None:
    assert free_space_violation(posts(ROBOT + 0.3), seeing(4.0), np.eye(4), every=1) == 1.0
    assert free_space_violation(posts(ROBOT - 0.3), seeing(4.0), np.eye(4), every=1) == 0.0


def test_the_worse_of_both_directions_counts() -> None:
    a, b = posts(2.0), seeing(4.0)
    assert (
        free_space_violation(a, b, np.eye(4), every=1)
        == free_space_violation(b, a, np.eye(4), every=1)
        == 1.0
    )


def test_scans_whose_sensor_is_not_known_contradict_nothing() -> None:
    unknown = replace(seeing(4.0), image=None)
    assert free_space_violation(posts(2.0), unknown, np.eye(4)) == 0.0
    assert free_space_violation(unknown, posts(2.0), np.eye(4)) == 0.0


def test_a_scan_contradicts_neither_itself_nor_another_at_its_true_pose(room: Room) -> None:
    a, b = (prepare(as_scan(scan.points), SETTINGS) for scan in room.before[:2])
    true = inverse(room.before[1].world_from_sensor) @ room.before[0].world_from_sensor
    assert free_space_violation(a, a, np.eye(4)) == 0.0
    assert free_space_violation(a, b, true) < 0.001
    assert free_space_violation(b, a, inverse(true)) < 0.001


def test_a_scan_of_the_same_room_a_metre_and_a_half_off_is_contradicted(room: Room) -> None:
    a, b = (prepare(as_scan(scan.points), SETTINGS) for scan in room.before[:2])
    wrong = inverse(room.before[1].world_from_sensor) @ shifted(1.5) @ room.before[0].world_from_sensor
    assert free_space_violation(a, b, wrong) > 5 * SETTINGS.max_free_space_violation


POOR = Hypothesis(
    target_from_source=np.eye(4),
    fitness=0.29,
    inlier_rmse=0.033,
    num_inliers=900,
    overlap=0.8,
    two_way_inlier_ratio=0.57,
    from_global_search=True,
    consistent_with_prior=False,
    contradicts_prior=False,
    oriented=True,
)


@pytest.mark.parametrize(
    ("values", "said", "unsaid"),
    [
        ({}, ["57.0% lie on each other", "at least 85% is needed"], ["fitness", "RMSE"]),
        ({"overlap": 0.1}, ["57.0%", "the map covers 10.0% of it", "over 0.55, it has 0.29"], ["RMSE"]),
        ({"two_way_inlier_ratio": 0.9, "inlier_rmse": 0.2}, ["RMSE is 20.0 cm"], ["fitness", "ratio"]),
        ({"two_way_inlier_ratio": 0.9, "contradicts_prior": True}, ["far from the pose prior"], ["ratio"]),
    ],
)
def test_a_refusal_names_the_conditions_that_do_not_hold_and_no_other(
    values: dict[str, object], said: list[str], unsaid: list[str]
) -> None:
    with pytest.raises(ScanRejected) as refused:
        require_accepted("b.ply", replace(POOR, **values), SETTINGS)  # type: ignore[arg-type]
    assert all(part in str(refused.value) for part in said)
    assert not any(part in str(refused.value) for part in unsaid)
