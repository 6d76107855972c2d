"""Parts of one simulated room as scans of their own; the global search is off, so that a prior has to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rooms import Room

from worker.errors import Cancelled, MapFailed, ScanError, ScanTooLarge
from worker.evaluation.sensor import SimulatedScan
from worker.pipeline.chaining import ScanFile, chain, place
from worker.pipeline.pcd import write_pcd
from worker.pipeline.poses import difference, exponential, inverse
from worker.pipeline.registration_settings import RegistrationSettings
from worker.pipeline.values import Matrix4

SETTINGS = RegistrationSettings(search_resolutions=(), max_iterations=10)
MANY = 1_000_000
THIN = 3  # every third point of a scan does here
#: where the sensor stood in the frame of the file, as a scanner writes it that has one frame for a whole walk
VIEWPOINT = exponential(np.array([0.1, -0.2, 0.7, 3.0, -2.0, 1.0]))


def written(
    path: Path,
    scan: SimulatedScan,
    *,
    between: tuple[float, float] = (-np.inf, np.inf),
    pose: Matrix4 | None = None,
    viewpoint: Matrix4 | None = None,
) -> ScanFile:
    """What the scan saw for x of the world in `between`; `pose` is the prior that is given."""
    x = scan.world_points[::THIN, 0]
    points = scan.points[::THIN][(x > between[0]) & (x < between[1])].astype(np.float64)
    if viewpoint is not None:
        points = points @ viewpoint[:3, :3].T + viewpoint[:3, 3]
    write_pcd(path, points.astype(np.float32), sensor_pose=viewpoint)
    return ScanFile(name=path.name, path=path, pose=pose)


def off(pose: Matrix4, truth: Matrix4) -> float:
    return difference(pose, truth)[0]


def test_the_first_scan_stands_at_its_prior(room: Room, tmp_path: Path) -> None:
    first = room.before[0]
    file = written(tmp_path / "a.pcd", first, pose=first.world_from_sensor)
    (outcome,), fused = chain([file], settings=SETTINGS, max_points=MANY)
    assert outcome.scan is not None
    assert outcome.scan.map_from_scan == pytest.approx(first.world_from_sensor)
    assert (outcome.fitness, outcome.inlier_rmse) == (None, None)  # there was nothing to fit to
    assert outcome.scan.points == pytest.approx(first.world_points[::THIN], abs=1e-4)
    assert fused.points.max(axis=0) == pytest.approx(first.world_points[::THIN].max(axis=0), abs=0.05)


def test_the_first_scan_stands_at_identity_without_a_prior(room: Room, tmp_path: Path) -> None:
    file = written(tmp_path / "a.pcd", room.before[0], viewpoint=VIEWPOINT)
    (outcome,), _ = chain([file], settings=SETTINGS, max_points=MANY)
    assert outcome.scan is not None
    assert outcome.scan.map_from_scan.tolist() == np.eye(4).tolist()
    assert outcome.scan.sensor_origin == pytest.approx(VIEWPOINT[:3, 3], abs=1e-5)


def test_a_prior_speaks_of_the_sensor_and_the_file_of_where_that_stood(room: Room, tmp_path: Path) -> None:
    first, second = room.before[:2]
    files = [
        written(tmp_path / "a.pcd", first, pose=first.world_from_sensor, viewpoint=VIEWPOINT),
        written(tmp_path / "b.pcd", second, pose=second.world_from_sensor, viewpoint=inverse(VIEWPOINT)),
    ]
    (a, b), _ = chain(files, settings=SETTINGS, max_points=MANY)
    assert a.scan is not None
    assert b.scan is not None
    assert a.scan.map_from_scan == pytest.approx(first.world_from_sensor @ inverse(VIEWPOINT), abs=1e-5)
    assert a.scan.points == pytest.approx(first.world_points[::THIN], abs=1e-3)
    assert a.scan.sensor_origin == pytest.approx(first.world_from_sensor[:3, 3], abs=1e-4)
    assert off(b.scan.map_from_scan, second.world_from_sensor @ VIEWPOINT) < 0.02


def test_a_scan_that_fits_only_after_another_is_tried_again(room: Room, tmp_path: Path) -> None:
    """West and east of the room share nothing; the whole room, given last, ties them together."""
    east, whole, west = room.before[:3]
    files = [
        written(tmp_path / "west.pcd", west, between=(-np.inf, 2.3), pose=west.world_from_sensor),
        written(tmp_path / "east.pcd", east, between=(3.0, np.inf), pose=east.world_from_sensor),
        written(tmp_path / "whole.pcd", whole, pose=whole.world_from_sensor),
    ]
    alone, _ = chain(files[:2], settings=SETTINGS, max_points=MANY)
    assert [outcome.scan is not None for outcome in alone] == [True, False]
    together, fused = chain(files, settings=SETTINGS, max_points=MANY)
    assert [outcome.name for outcome in together] == ["west.pcd", "east.pcd", "whole.pcd"]
    for outcome, truth in zip(together, (west, east, whole), strict=True):
        assert outcome.scan is not None
        assert outcome.reason is None
        assert off(outcome.scan.map_from_scan, truth.world_from_sensor) < 0.03
    assert fused.points[:, 0].max() > 4.0  # metres: what the east saw is in the map


def test_a_rejected_scan_has_a_reason_and_numbers_and_adds_nothing(room: Room, tmp_path: Path) -> None:
    first, second = room.before[:2]
    astray = second.world_from_sensor @ exponential(np.array([0, 0, np.pi / 2, 2.5, 0, 0]))
    files = [
        written(tmp_path / "a.pcd", first, pose=first.world_from_sensor),
        written(tmp_path / "astray.pcd", second, pose=astray),
    ]
    (a, astray_outcome), fused = chain(files, settings=SETTINGS, max_points=MANY)
    assert a.scan is not None
    assert astray_outcome.scan is None
    assert astray_outcome.reason is not None
    assert astray_outcome.reason.startswith("scan astray.pcd: fitness 0.")
    assert astray_outcome.fitness is not None
    assert 0 < astray_outcome.fitness < 1
    assert astray_outcome.inlier_rmse is not None
    assert 0 < astray_outcome.inlier_rmse < 0.05
    assert fused.points.tolist() == a.scan.voxels(0.05).points.tolist()


def test_an_accepted_scan_carries_the_numbers_of_its_registration(room: Room, tmp_path: Path) -> None:
    scan = room.after[0]
    file = written(tmp_path / "now.pcd", scan, pose=scan.world_from_sensor)
    outcome = place(file, room.target, settings=SETTINGS, max_points=MANY)
    assert outcome.scan is not None
    assert (outcome.fitness, outcome.inlier_rmse) == (outcome.scan.fitness, outcome.scan.inlier_rmse)
    assert outcome.scan.fitness > 0.5


@pytest.mark.parametrize("place_of_it", [0, 1])
def test_a_file_that_is_no_scan_is_named(room: Room, tmp_path: Path, place_of_it: int) -> None:
    first = room.before[0]
    files = [written(tmp_path / "a.pcd", first, pose=first.world_from_sensor)]
    (tmp_path / "x.bin").write_bytes(b"nothing like a scan")
    files.insert(place_of_it, ScanFile(name="broken scan.ply", path=tmp_path / "x.bin"))
    with pytest.raises(ScanError, match=r"^broken scan\.ply: neither PLY nor PCD"):
        chain(files, settings=SETTINGS, max_points=MANY)


def test_a_scan_of_more_points_than_the_limit_is_refused(room: Room, tmp_path: Path) -> None:
    file = written(tmp_path / "a.pcd", room.before[0])
    with pytest.raises(ScanTooLarge, match=r"^a\.pcd: "):
        chain([file], settings=SETTINGS, max_points=1000)


def test_progress_rises_to_1_though_a_scan_is_rejected(room: Room, tmp_path: Path) -> None:
    first, second = room.before[:2]
    files = [
        written(tmp_path / "a.pcd", first, pose=first.world_from_sensor),
        written(tmp_path / "b.pcd", second, pose=second.world_from_sensor),
        written(tmp_path / "astray.pcd", second, pose=exponential(np.array([0, 0, 0, 50.0, 0, 0]))),
    ]
    told: list[tuple[str, float]] = []
    chain(files, settings=SETTINGS, max_points=MANY, progress=lambda *at: told.append(at))
    assert {stage for stage, _ in told} == {"registering"}
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert list(dict.fromkeys(shares)) == pytest.approx(
        [1 / 3, 2 / 3, 1.0]
    )  # the first needs no registration


def test_a_dismissal_stops_the_registration_before_its_next_iteration(room: Room, tmp_path: Path) -> None:
    first, second = room.before[:2]
    files = [
        written(tmp_path / "a.pcd", first, pose=first.world_from_sensor),
        written(tmp_path / "b.pcd", second, pose=second.world_from_sensor),
    ]
    calls = 0

    def dismissed_at_the_third(stage: str, share: float) -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise Cancelled("the job was dismissed")

    with pytest.raises(Cancelled):
        chain(files, settings=SETTINGS, max_points=MANY, progress=dismissed_at_the_third)
    assert calls == 3


def _bare_plane(path: Path) -> ScanFile:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-4, 4, (40_000, 2)), rng.normal(-0.4, 0.015, 40_000)])
    write_pcd(path, plane.astype(np.float32))
    return ScanFile(name=path.name, path=path)


def test_a_bare_plane_makes_no_map(tmp_path: Path) -> None:
    with pytest.raises(MapFailed, match=r"plane\.pcd: its surfaces leave a motion free"):
        chain([_bare_plane(tmp_path / "plane.pcd")], settings=SETTINGS, max_points=MANY)


def test_the_first_scan_that_holds_a_pose_sets_the_frame(room: Room, tmp_path: Path) -> None:
    first = written(tmp_path / "first.pcd", room.before[0], pose=room.before[0].world_from_sensor)
    files = [_bare_plane(tmp_path / "plane.pcd"), first]
    outcomes, _ = chain(files, settings=SETTINGS, max_points=MANY)
    assert outcomes[0].scan is None
    assert "leave a motion free" in str(outcomes[0].reason)
    assert outcomes[1].scan is not None
    assert off(outcomes[1].scan.map_from_scan, room.before[0].world_from_sensor) == 0
