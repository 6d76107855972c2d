from __future__ import annotations

import numpy as np
from rooms import Room

from worker.evaluation.visits import merged
from worker.pipeline.visibility import ENOUGH, share_in_front


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
