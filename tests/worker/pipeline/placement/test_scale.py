from __future__ import annotations

import numpy as np
import pytest

from tests.support.rooms import Room
from worker.cloud.poses import difference, exponential
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.placement.scale import ScaleEstimate, estimate_scale
from worker.pipeline.registration.surface import Surface

NUDGED = exponential(np.array([0.0, 0.0, np.radians(1.0), 0.03, -0.02, 0.02]))


def _estimate(room: Room, factor: float, *, number: int = 0) -> tuple[ScaleEstimate, Matrix4]:
    """Estimate the scale of a scan whose file was multiplied by `factor`, from a little off its true pose."""
    scan = room.after[number]
    points, normals = scan.points[::10].astype(np.float64), np.zeros((len(scan.points[::10]), 3))
    source = Surface.of(points * factor, normals, np.zeros(len(points), bool))
    truth = scan.world_from_sensor
    return estimate_scale(source, room.target, truth @ NUDGED, np.zeros(3)), truth


@pytest.mark.parametrize("factor", [0.9, 0.98, 0.99, 1.0, 1.01, 1.05, 1.1])
def test_the_scale_of_a_stretched_scan_is_told_within_half_a_percent_and_four_sigmas(
    room: Room, factor: float
) -> None:
    estimate, truth = _estimate(room, factor)
    assert estimate.scale * factor == pytest.approx(1.0, abs=0.005)
    assert abs(estimate.scale * factor - 1) < 4 * estimate.sigma
    assert 0.0005 < estimate.sigma < 0.003
    metres, radians = difference(estimate.target_from_source, truth)
    assert metres < 0.02
    assert np.degrees(radians) < 0.3


def test_a_right_scan_is_not_called_off_and_one_off_by_a_percent_is(room: Room) -> None:
    right, _ = _estimate(room, 1.0, number=1)
    wrong, _ = _estimate(room, 1.01, number=1)
    assert not right.is_off_by(0.006)
    assert wrong.is_off_by(0.006)
    assert wrong.residual_after < 0.9 * wrong.residual_before
    assert right.residual_after == pytest.approx(wrong.residual_after, abs=0.002)


def test_ranges_that_are_all_a_centimetre_too_long_are_not_taken_for_a_scale(room: Room) -> None:
    """Without the offset among the unknowns the room would be 0.4% too large."""
    scan = room.after[0]
    points = scan.points[::10].astype(np.float64)
    longer = points * (1 + 0.01 / np.linalg.norm(points, axis=1))[:, None]
    source = Surface.of(longer, np.zeros_like(points), np.zeros(len(points), bool))
    estimate = estimate_scale(source, room.target, scan.world_from_sensor, np.zeros(3))
    assert abs(estimate.scale - 1) < 0.0025


def test_a_bare_wall_holds_no_scale_and_two_that_face_each_other_do() -> None:
    one, other = _wall(np.random.default_rng(0)), _wall(np.random.default_rng(1))
    assert estimate_scale(_faced(one), _faced(other), np.eye(4)).sigma > 0.05
    both, others = (np.concatenate([wall, wall * (1, -1, 1)]) for wall in (one, other))
    assert estimate_scale(_faced(both), _faced(others), np.eye(4)).sigma < 0.01


def _wall(rng: np.random.Generator) -> Floats:
    """(4000, 3) noisy points of a wall at y = 2."""
    return np.column_stack([rng.uniform(-4, 4, 4000), rng.normal(2.0, 0.01, 4000), rng.uniform(-1, 2, 4000)])


def _faced(points: Floats) -> Surface:
    normals = np.zeros_like(points)
    normals[:, 1] = -np.sign(points[:, 1])
    return Surface.of(points, normals, np.ones(len(points), bool))


def test_surfaces_that_are_metres_apart_say_nothing_of_a_scale(room: Room) -> None:
    away = np.eye(4)
    away[2, 3] = 50.0
    estimate = estimate_scale(room.target, room.target, away)
    assert (estimate.scale, estimate.sigma) == (1.0, np.inf)
    assert not estimate.is_off_by(0.0)
