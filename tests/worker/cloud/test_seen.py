"""Seen: voxels with hits and range images, of scans one by one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from worker.cloud import npz
from worker.cloud.seen import Seen
from worker.cloud.types import Floats, Points
from worker.cloud.voxels import Voxels


@dataclass(frozen=True)
class Placed:
    points: Points
    sensor_origin: Floats | None


def scan(seed: int, *, origin: bool = True) -> Placed:
    points = np.random.default_rng(seed).uniform(0, 1, (2000, 3)).astype(np.float32)
    return Placed(points=points, sensor_origin=np.array([0.5, 0.5, 3.0]) if origin else None)


def test_voxels_are_those_of_all_points_with_their_hits() -> None:
    scans = [scan(1), scan(2), scan(3)]
    seen = Seen.of(scans, voxel_size=0.05)
    whole = Voxels.of(np.concatenate([one.points for one in scans]), size=0.05)
    assert np.array_equal(seen.keys, whole.keys)
    assert np.array_equal(seen.hits, whole.counts)
    assert seen.points == pytest.approx(whole.points, abs=1e-5)
    assert seen.sights is not None
    assert len(seen.sights) == 3


def test_a_scan_without_its_sensors_place_gives_hits_alone() -> None:
    seen = Seen.of([scan(1, origin=False), scan(2)], voxel_size=0.05)
    assert seen.sights is not None
    assert (len(seen.sights), int(seen.hits.sum())) == (1, 4000)
    assert Seen.of([scan(1, origin=False)], voxel_size=0.05).sights is None


def test_two_visits_merge_to_what_their_scans_together_are() -> None:
    apart = Seen.of([scan(1), scan(2)], voxel_size=0.05).merged(Seen.of([scan(3)], voxel_size=0.05))
    together = Seen.of([scan(1), scan(2), scan(3)], voxel_size=0.05)
    assert np.array_equal(apart.keys, together.keys)
    assert np.array_equal(apart.hits, together.hits)
    assert apart.points == pytest.approx(together.points, abs=1e-5)
    assert apart.sights is not None
    assert together.sights is not None
    assert np.array_equal(apart.sights.nearest, together.sights.nearest)


def test_voxels_can_be_taken_out() -> None:
    seen = Seen.of([scan(1)], voxel_size=0.25)
    gone = seen.points[:, 0] > 0.5
    rest = seen.without(gone)
    assert len(rest.keys) == int((~gone).sum())
    assert (rest.points[:, 0] <= 0.5).all()


def test_no_scan_has_seen_nothing() -> None:
    seen = Seen.of([], voxel_size=0.05)
    assert (len(seen.keys), seen.sights) == (0, None)
    assert seen.verdicts(np.zeros((2, 3), np.float32)).judged.tolist() == [False, False]


@pytest.mark.parametrize("origin", [True, False])
def test_it_comes_back_from_its_file(tmp_path: Path, origin: bool) -> None:
    seen = Seen.of([scan(1, origin=origin)], voxel_size=0.05)
    npz.save(tmp_path / "seen.npz", seen)
    back = npz.load(tmp_path / "seen.npz", Seen)
    assert np.array_equal(back.keys, seen.keys)
    assert back.voxel_size == 0.05
    assert (back.sights is None) == (seen.sights is None)
    if back.sights is not None and seen.sights is not None:
        assert np.array_equal(back.sights.farthest, seen.sights.farthest)


def test_a_scan_takes_a_quarter_of_a_megabyte(tmp_path: Path) -> None:
    seen = Seen.of([scan(1)], voxel_size=1.0)
    npz.save(tmp_path / "seen.npz", seen)
    assert (tmp_path / "seen.npz").stat().st_size < 260_000
