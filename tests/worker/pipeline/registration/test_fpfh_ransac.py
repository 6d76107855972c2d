from __future__ import annotations

from itertools import combinations, islice

import numpy as np
import pytest

from tests.support.rooms import Room
from worker.cloud.poses import difference, inverse, transformed
from worker.cloud.types import Matrix4
from worker.cloud.voxels import Voxels
from worker.pipeline.registration import fpfh_ransac
from worker.pipeline.registration.fpfh_ransac import fpfh_candidates
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, surface_of


@pytest.fixture(scope="module")
def source(room: Room) -> Surface:
    voxels = Voxels.of(room.after[0].points, size=0.05, origin=np.zeros(3))
    return surface_of(voxels, RegistrationSettings())


@pytest.fixture(scope="module")
def found(room: Room, source: Surface) -> list[Matrix4]:
    return list(fpfh_candidates(source, room.target, resolutions=(0.3, 0.2), seeds=2))


def test_a_candidate_stands_within_reach_of_icp(room: Room, found: list[Matrix4]) -> None:
    off = [difference(pose, room.after[0].world_from_sensor) for pose in found]
    assert any(metres < 0.6 and radians < 0.26 for metres, radians in off)


def test_candidates_are_rigid(found: list[Matrix4]) -> None:
    for pose in found:
        assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-6)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        assert pose[3].tolist() == [0, 0, 0, 1]


def test_no_two_candidates_end_in_the_same_place(found: list[Matrix4]) -> None:
    assert 1 <= len(found) <= 4
    for a, b in combinations(found, 2):
        metres, radians = difference(a, b)
        assert metres >= 0.5 or radians >= 0.26


def test_who_is_content_with_the_first_pays_for_one_resolution(
    room: Room, source: Surface, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[float] = []
    real = fpfh_ransac._Features

    def counted(surface: Surface, resolution: float) -> object:
        made.append(resolution)
        return real(surface, resolution)

    monkeypatch.setattr(fpfh_ransac, "_Features", counted)
    poses = fpfh_candidates(source, room.target, resolutions=(0.3, 0.2), seeds=2)
    next(poses)
    assert made == [0.3, 0.3]  # of the scan and of the map
    list(poses)
    assert made == [0.3, 0.3, 0.2, 0.2]  # and once each, whatever the number of seeds


def test_no_resolution_gives_no_candidate(room: Room, source: Surface) -> None:
    assert list(fpfh_candidates(source, room.target, resolutions=(), seeds=3)) == []


def test_the_pose_is_target_from_source(room: Room, source: Surface, found: list[Matrix4]) -> None:
    """The best candidate lays most of the scan near the map; no inverse does."""

    def near(pose: Matrix4) -> float:
        distance, _ = room.target.nearest(transformed(source.points, pose), within=0.3)
        return float(np.isfinite(distance).mean())

    best = max(found, key=near)
    assert near(best) > 0.8
    assert near(inverse(best)) < near(best) - 0.2


def test_the_same_clouds_give_the_same_first_candidate(room: Room, source: Surface) -> None:
    first, again = (
        next(islice(fpfh_candidates(source, room.target, resolutions=(0.3,), seeds=1), 1)) for _ in range(2)
    )
    metres, radians = difference(first, again)
    assert metres < 0.5
    assert radians < 0.26
