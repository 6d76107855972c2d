from __future__ import annotations

import numpy as np
import pytest

from tests.support.rooms import Room, wall
from worker.cloud.visibility import ENOUGH, RangeImage, share_in_front
from worker.simulation.visits import merged


@pytest.fixture(scope="module")
def image() -> RangeImage:
    """A wall three metres ahead, seen from (1, 0, 0)."""
    return RangeImage.of(wall(4.0), np.array([1.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("x", "through"),
    [(2.0, True), (3.4, True), (3.6, False), (4.0, False), (5.0, False), (-1.0, False)],
)
def test_a_point_well_before_the_wall_is_seen_through_and_one_at_or_behind_it_is_not(
    image: RangeImage, x: float, through: bool
) -> None:
    """Of 3 m, 30 cm and 5 percent are margin; behind the sensor nothing was seen, which proves nothing."""
    assert image.free_space_violation(np.array([[x, 0.0, 0.0]])).tolist() == [through]


def test_directions_in_which_nothing_came_back_prove_nothing(image: RangeImage) -> None:
    beside = np.array([[2.0, 1.5, 0.0], [2.0, 0.0, -1.5], [1.0, 0.0, 2.0]])
    assert not image.free_space_violation(beside).any()


def test_beside_an_edge_the_nearer_range_counts() -> None:
    """A pillar two metres ahead on the left, a wall at five metres behind: the cell next to the pillar's is unsure."""
    points = np.concatenate([wall(2.0, y=(0.0, 1.0)), wall(5.0, y=(-3.0, 0.0))])
    image = RangeImage.of(points, np.zeros(3))
    beside, clear = np.array([[3.0, -0.12, 0.0]]), np.array([[3.0, -0.5, 0.0]])
    assert image.free_space_violation(beside).tolist() == [False]
    assert image.free_space_violation(clear).tolist() == [True]


def test_the_nearest_return_of_a_direction_is_what_counts() -> None:
    both = np.concatenate([wall(5.0), wall(2.0)])
    image = RangeImage.of(both, np.zeros(3))
    assert not image.free_space_violation(np.array([[2.5, 0.0, 0.0], [3.5, 0.2, 0.1]])).any()


def test_a_standing_scan_was_seen_from_its_sensor(room: Room) -> None:
    assert all(share_in_front(scan.points, np.zeros(3)) > ENOUGH for scan in room.before)


def test_a_scan_was_not_seen_from_outside_the_room(room: Room) -> None:
    assert share_in_front(room.before[0].points, np.array([8.0, 3.0, 0.5])) < ENOUGH


def test_two_concentric_spheres_are_not_seen_from_their_middle() -> None:
    rays = np.random.default_rng(0).normal(size=(60_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    both = np.concatenate([2 * rays[:30_000], 4 * rays[30_000:]])
    assert share_in_front(both, np.zeros(3)) < 0.6


def test_scans_merged_from_several_places_are_not_trusted(room: Room) -> None:
    cloud = merged(room.before)
    assert share_in_front(cloud, np.array([20.0, 0.0, 0.0])) < ENOUGH


def test_nothing_but_the_origin_is_seen_from_nowhere() -> None:
    assert share_in_front(np.zeros((5, 3)), np.zeros(3)) == 0.0


@pytest.mark.parametrize("shift", [(3000.0, 2000.0, 0.0), (100.0, 0.0, 0.0), (0.0, 0.0, 60.0)])
def test_a_scan_was_not_seen_from_far_outside_it(room: Room, shift: tuple[float, float, float]) -> None:
    """As in a file whose points were moved into a map's grid while its viewpoint was left at zero."""
    points = room.before[0].points.astype(np.float64)
    assert share_in_front(points + shift, np.zeros(3)) < ENOUGH


def test_a_storey_was_not_seen_from_high_above_it() -> None:
    """Its floor and the top of its walls, seen from 60 m above it."""
    east, north = (axis.ravel() for axis in np.meshgrid(np.arange(-20, 20, 0.2), np.arange(-20, 20, 0.2)))
    floor = np.column_stack([east, north, np.zeros_like(east)])
    tops = floor[np.rint(east * 5) % 5 == 0] + (0.0, 0.0, 2.9)
    assert share_in_front(np.concatenate([floor, tops]), np.array([0.0, 0.0, 60.0])) < ENOUGH


def test_a_wall_before_a_camera_was_seen_by_it() -> None:
    assert share_in_front(wall(4.0, y=(-1.0, 1.0)), np.zeros(3)) > ENOUGH


def test_what_was_seen_is_the_same_whatever_is_gone_through_at_once(monkeypatch) -> None:
    rng = np.random.default_rng(2)
    rays = rng.normal(size=(2000, 3))
    points = rays / np.abs(rays).max(axis=1)[:, None] * np.where(rng.random(2000) < 0.3, 2, 5)[:, None]
    whole, image = share_in_front(points, np.zeros(3)), RangeImage.of(points, np.zeros(3))
    monkeypatch.setattr("worker.cloud.visibility._AT_ONCE", 13)
    assert share_in_front(points, np.zeros(3)) == whole
    assert 0 < whole < 1
    np.testing.assert_array_equal(RangeImage.of(points, np.zeros(3)).ranges, image.ranges)
