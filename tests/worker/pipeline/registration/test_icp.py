from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.poses import difference, exponential
from worker.errors import Cancelled
from worker.pipeline.registration.icp import icp
from worker.pipeline.registration.surface import Surface, facing


def _corner(*, noise: float = 0.0) -> Surface:
    """Three walls that meet in the origin, seen from inside."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(0, 2, (3, 1500, 2))
    points = np.concatenate([np.insert(flat[axis], axis, 0.0, axis=1) for axis in range(3)])
    normals = np.repeat(np.eye(3), 1500, axis=0)
    return Surface.of(points + rng.normal(0, noise, points.shape), normals, np.ones(4500, bool))


def test_icp_undoes_a_known_motion() -> None:
    corner = _corner()
    motion = exponential(np.array([0.01, -0.02, 0.015, 0.03, -0.02, 0.01]))
    moved = Surface.of(
        corner.points @ motion[:3, :3].T + motion[:3, 3], corner.normals @ motion[:3, :3].T, corner.oriented
    )
    found = icp(corner, moved, np.eye(4), max_correspondence_distance=0.2)
    metres, radians = difference(found.target_from_source, motion)
    assert found.converged
    assert metres < 1e-3
    assert radians < 1e-3
    assert found.fitness == pytest.approx(1.0)


def test_fitness_and_rmse_are_those_of_the_gate() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    up, known = np.tile([0.0, 0, 1], (4, 1)), np.ones(4, bool)
    target = Surface.of(points, up, known)
    aside = np.array([[0, 0.03, 0], [0, 0.04, 0], [0, 0.2, 0], [0, 0.3, 0]])
    source = Surface.of(points + aside, up, known)
    found = icp(source, target, np.eye(4), max_correspondence_distance=0.05)
    assert found.fitness == 0.5
    assert found.num_inliers == 2
    assert found.inlier_rmse == pytest.approx(np.sqrt((0.03**2 + 0.04**2) / 2))
    assert not found.converged


def test_a_start_that_meets_nothing_is_returned_as_it_was() -> None:
    far = exponential(np.array([0, 0, 0, 50, 0, 0.0]))
    found = icp(_corner(), _corner(), far, max_correspondence_distance=0.1)
    assert (found.target_from_source == far).all()
    assert (found.fitness, found.inlier_rmse) == (0.0, float("inf"))


def test_pairs_on_the_two_sides_of_a_wall_are_left_out_only_where_the_sides_are_known() -> None:
    points, toward = np.zeros((2, 3)), np.array([[1.0, 0, 0], [1.0, 0, 0]])
    known = Surface.of(points, toward, np.array([True, True]))
    half_known = Surface.of(points, -toward, np.array([True, False]))
    index = np.array([0, 1])
    assert facing(known, half_known, np.eye(4), index, np.array([True, True])).tolist() == [False, True]


def test_tick_may_stop_the_loop() -> None:
    def stop() -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        icp(_corner(), _corner(), np.eye(4), max_correspondence_distance=0.1, tick=stop)
