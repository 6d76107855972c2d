from __future__ import annotations

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room, as_scan
from worker.cloud.poses import difference, inverse, transformed
from worker.cloud.types import Matrix4
from worker.pipeline.registration.bev_correlation import (
    CELL,
    PAIR_SIZE,
    YAWS,
    BevImage,
    bev_candidates,
    correlate,
    image_size,
    rotated_spectra,
    spectrum,
)
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface

SETTINGS = RegistrationSettings()
NEAR = (
    0.6,
    np.radians(6),
)  # metres, radians: two pixels, a turn and a half; coarse alignment takes it from there


@pytest.fixture(scope="module")
def seen(room: Room) -> Surface:
    return prepare(as_scan(room.after[0].points), SETTINGS).surface


def moved(surface: Surface, pose: Matrix4) -> Surface:
    normals = surface.normals @ pose[:3, :3].T
    return Surface.of(transformed(surface.points, pose), normals, surface.oriented)


def hits(found: list[Matrix4], truth: Matrix4) -> list[int]:
    """Which of the candidates are near."""
    off = [difference(pose, truth) for pose in found]
    return [n for n, (metres, radians) in enumerate(off) if metres < NEAR[0] and radians < NEAR[1]]


@pytest.mark.parametrize("degrees", [0, 37, 90, 143, 200, 271, 330])
def test_a_room_seen_on_another_day_is_found_at_any_turn_and_shift(
    room: Room, seen: Surface, degrees: float
) -> None:
    away = shifted(6.3, -4.1, yaw=np.radians(degrees))
    found = bev_candidates(moved(seen, away), room.target, count=6)
    assert len(found) == 6
    assert min(hits(found, room.after[0].world_from_sensor @ inverse(away)), default=9) < 3


def test_two_scans_of_one_room_are_found_in_each_other(room: Room, seen: Surface) -> None:
    other = prepare(as_scan(room.before[1].points), SETTINGS).surface
    truth = inverse(room.before[1].world_from_sensor) @ room.after[0].world_from_sensor
    view, target = BevImage.of(seen), BevImage.of(other)
    rotated, spectra = rotated_spectra(view, PAIR_SIZE), spectrum(target, PAIR_SIZE)
    found = correlate(view, rotated, target, spectra, count=6)
    assert hits([match.target_from_source for match in found], truth)
    scores = [match.score for match in found]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] > 0


@pytest.mark.parametrize("lift", [-0.3, 0.0, 0.25])
def test_the_height_comes_from_floors_and_ceilings(room: Room, seen: Surface, lift: float) -> None:
    lifted = moved(seen, shifted(z=lift))
    (first, *_) = bev_candidates(lifted, room.target, count=1)
    assert first[2, 3] == pytest.approx(room.after[0].world_from_sensor[2, 3] - lift, abs=0.06)


def box(x: float, y: float, *, inward: bool) -> tuple[np.ndarray, np.ndarray]:
    """Walls of 4.2 x 3 m, 2 m high, centred in (x, y), seen from inside or from outside: points, normals."""
    points, normals = [], []
    for axis, half in ((0, 2.1), (1, 1.5)):
        along, up = np.meshgrid(np.arange(-(3.6 - half), 3.6 - half, 0.05), np.arange(-0.4, 1.6, 0.1))
        for side in (-1, 1):
            wall = np.zeros((along.size, 3))
            wall[:, axis], wall[:, 1 - axis], wall[:, 2] = side * half, along.ravel(), up.ravel()
            normal = np.zeros(3)
            normal[axis] = -side if inward else side
            points.append(wall + np.array([x, y, 0]))
            normals.append(np.tile(normal, (len(wall), 1)))
    return np.concatenate(points), np.concatenate(normals)


def surface_of_boxes(*boxes: tuple[np.ndarray, np.ndarray], oriented: bool = True) -> Surface:
    points, normals = (np.concatenate(each) for each in zip(*boxes, strict=True))
    return Surface.of(points, normals, np.full(len(points), oriented))


def test_a_room_is_not_taken_for_a_block_of_its_size_that_was_seen_from_outside() -> None:
    inside, outside = (surface_of_boxes(box(0, 0, inward=inward)) for inward in (True, False))
    both = surface_of_boxes(box(-5.1, 0.9, inward=False), box(4.8, 0.6, inward=True))
    found = bev_candidates(inside, both, count=1)
    assert found[0][:2, 3] == pytest.approx([4.8, 0.6], abs=CELL)
    found = bev_candidates(outside, both, count=1)
    assert found[0][:2, 3] == pytest.approx([-5.1, 0.9], abs=CELL)


def test_no_walls_whose_seen_side_is_known_give_no_candidate(seen: Surface) -> None:
    unknown = surface_of_boxes(box(0, 0, inward=True), oriented=False)
    known = surface_of_boxes(box(0, 0, inward=True))
    assert bev_candidates(unknown, known, count=5) == []
    assert bev_candidates(known, unknown, count=5) == []
    flat = np.random.default_rng(0).uniform(-2, 2, (500, 3)) * (1, 1, 0)
    floor = Surface.of(flat, np.tile([0.0, 0, 1], (500, 1)), np.ones(500, bool))
    assert bev_candidates(floor, known, count=5) == []


def test_no_two_candidates_are_next_to_each_other(room: Room, seen: Surface) -> None:
    found = bev_candidates(seen, room.target, count=8)
    assert len(found) == 8
    for number, pose in enumerate(found):
        for other in found[:number]:
            metres, radians = difference(pose, other)
            assert metres > CELL or radians > 2 * np.pi / YAWS


def test_candidates_are_upright_and_rigid(room: Room, seen: Surface) -> None:
    for pose in bev_candidates(seen, room.target, count=4):
        assert pose[2, :3].tolist() == [0, 0, 1]
        assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3))


def test_a_picture_is_as_large_as_the_larger_view(room: Room, seen: Surface) -> None:
    small, large = (
        BevImage.of(seen),
        BevImage.of(surface_of_boxes(box(0, 0, inward=True), box(40, 0, inward=True))),
    )
    assert image_size(small, large) == image_size(large) > image_size(small)
    assert image_size(large) * CELL > 44 + 2
