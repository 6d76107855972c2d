from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room, as_scan
from worker.cloud.poses import inverse
from worker.cloud.visibility import ENOUGH, RangeImage, share_in_front
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import ROBOT, free_space_violation
from worker.simulation.visits import merged

SETTINGS = RegistrationSettings()


def wall(x: float, *, y: tuple[float, float] = (-2.0, 2.0)) -> np.ndarray:
    """4 m high, across the x axis, a point every 2 cm."""
    across, up = np.meshgrid(np.arange(*y, 0.02), np.arange(-2, 2, 0.02))
    return np.column_stack([np.full(across.size, x), across.ravel(), up.ravel()])


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
