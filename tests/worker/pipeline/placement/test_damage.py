from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.support.rooms import Room
from worker.cloud.formats.scan import read_scan
from worker.cloud.types import Points
from worker.pipeline.placement.damage import damage_of

RNG = np.random.default_rng(0)
REAL = (
    "room_scan/room_scan1.pcd",
    "ipad_rooms/pix4d_database_560_db.ply",
    "kinect_pairwise/capture0001.pcd",
    "corridor_pair/cloud_0.ply",
    "floor/geb079_occ.ply",
)


@pytest.mark.parametrize("name", REAL)
def test_real_scans_are_not_damaged(shared_data: Path, name: str) -> None:
    assert damage_of(read_scan(shared_data / name).points) is None


@pytest.mark.parametrize("every", [1, 20])
@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_a_scan_is_not_damaged_however_thin_and_in_whatever_unit(
    room: Room, every: int, factor: float
) -> None:
    assert damage_of(room.after[0].points[::every] * np.float32(factor)) is None


def _at_one_place(points: Points) -> Points:
    return np.where(RNG.random((len(points), 1)) < 0.9, points[5], points)


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (np.round, "lie on each other (0% of them are distinct"),
        (_at_one_place, "one voxel holds 90%"),
        (lambda points: RNG.uniform(-4, 4, points.shape), "lie on no surfaces"),
        (lambda points: RNG.uniform(-4, 4, (3000, 3)), "lie on no surfaces"),
        (lambda points: np.column_stack([RNG.permutation(points[:, 0]), points[:, 1:]]), "no surfaces"),
        (lambda points: np.concatenate([points, RNG.uniform(-5, 5, points.shape)]), "no surfaces"),
    ],
    ids=["rounded to a metre", "most at one place", "noise", "thin noise", "x shuffled", "half noise"],
)
def test_a_broken_scan_is_damaged_and_told_how(
    room: Room, broken: Callable[[Points], Points], said: str
) -> None:
    damage = damage_of(broken(room.after[0].points).astype(np.float32))
    assert damage is not None
    assert said in damage.detail
    assert all(0 <= share <= 1 for share in damage.numbers.values())


def test_no_points_are_no_damage() -> None:
    assert damage_of(np.empty((0, 3), np.float32)) is None
