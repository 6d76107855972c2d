"""Scans of one simulated room, thinned, become a map; every pose is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room
from tests.support.walks import (
    MANY,
    QUICK,
    hanging,
    joint_settings,
    never_falls,
    off,
    registered,
    spread,
    written,
)
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.poses import exponential, inverse
from worker.cloud.types import Matrix4
from worker.errors import Cancelled, MapFailed, ScanError, ScanTooLarge
from worker.pipeline.mapping.map_registration import MapRegistration, register_map_scans
from worker.pipeline.mapping.settings import JointRegistrationSettings, MappingSettings
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.registration.results import read_registered as read_again
from worker.progress import Progress, no_progress
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

#: where the sensor stood in the frame of the file, as a scanner writes it that has one frame for a whole walk
VIEWPOINT = exponential(np.array([0.1, -0.2, 0.7, 3.0, -2.0, 1.0]))
#: without any search, so that a prior has to do
PRIORS_ONLY = joint_settings(QUICK.model_copy(update={"search_resolutions": ()}))


def register(
    files: Sequence[ScanFile],
    settings: JointRegistrationSettings = PRIORS_ONLY,
    progress: Progress = no_progress,
) -> MapRegistration:
    return register_map_scans(files, settings=settings, processes=1, progress=progress)


def poses_of(found: MapRegistration) -> dict[int, Matrix4]:
    return {
        number: each.registration.map_from_scan
        for number, each in enumerate(found.outcomes)
        if each.registration is not None
    }


def truth_of(room: Room) -> dict[int, Matrix4]:
    return {number: scan.world_from_sensor for number, scan in enumerate(room.before)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scans")


@pytest.fixture(scope="module")
def drifted(room: Room, folder: Path) -> tuple[ScanFile, ...]:
    """The four scans of the first visit; priors are off by 10 cm and 2 degrees."""
    files = []
    for number, scan in enumerate(room.before):
        drift = shifted(0.1 * (-1) ** number, 0.05 * number - 0.08, yaw=np.radians(2) * (-1) ** (number // 2))
        pose = scan.world_from_sensor @ drift
        files.append(written(folder / f"drifted-{number}.pcd", scan, pose=pose))
    return tuple(files)


@pytest.fixture(scope="module")
def foreign(folder: Path) -> ScanFile:
    """Of another room, without a prior."""
    return written(folder / "foreign.pcd", visit(random_room(11), 1, seed=5)[0])


@pytest.fixture(scope="module")
def together(drifted: tuple[ScanFile, ...]) -> tuple[MapRegistration, list[tuple[str, float]]]:
    told: list[tuple[str, float]] = []
    return register(drifted, progress=lambda *at: told.append(at)), told


# one scan


def test_a_single_scan_stands_at_its_prior(room: Room, tmp_path: Path) -> None:
    first = room.before[0]
    found = register([written(tmp_path / "a.pcd", first, pose=first.world_from_sensor)])
    (outcome,) = found.outcomes
    assert registered(outcome).map_from_scan == pytest.approx(first.world_from_sensor)
    assert (outcome.fitness, outcome.inlier_rmse) == (None, None)  # there was nothing to fit to
    assert registered(outcome).uncertainty is None
    assert registered(outcome).path == (0,)
    assert not registered(outcome).from_global_search
    assert (found.report.scans, found.report.accepted, found.report.pairs_possible) == (1, 1, 0)


def test_a_single_scan_stands_at_identity_without_a_prior(room: Room, tmp_path: Path) -> None:
    (outcome,) = register([written(tmp_path / "a.pcd", room.before[0], viewpoint=VIEWPOINT)]).outcomes
    assert registered(outcome).map_from_scan.tolist() == np.eye(4).tolist()
    assert registered(outcome).sensor_origin == pytest.approx(VIEWPOINT[:3, 3], abs=1e-5)


def test_a_prior_speaks_of_the_sensor_and_the_file_of_where_that_stood(room: Room, tmp_path: Path) -> None:
    first, second = room.before[:2]
    files = [
        written(tmp_path / "a.pcd", first, pose=first.world_from_sensor, viewpoint=VIEWPOINT),
        written(tmp_path / "b.pcd", second, pose=second.world_from_sensor, viewpoint=inverse(VIEWPOINT)),
    ]
    a, b = (registered(outcome) for outcome in register(files).outcomes)
    assert a.map_from_scan == pytest.approx(first.world_from_sensor @ inverse(VIEWPOINT), abs=1e-5)
    assert a.sensor_origin == pytest.approx(first.world_from_sensor[:3, 3], abs=1e-4)
    again = read_again(files[0], a, max_points=MANY)
    assert again.points == pytest.approx(first.world_points[::3], abs=1e-3)
    assert off(b.map_from_scan, second.world_from_sensor @ VIEWPOINT) < 0.02


# many scans


def test_scans_with_drifted_priors_come_to_a_centimetre_of_each_other(
    room: Room, together: tuple[MapRegistration, list[tuple[str, float]]]
) -> None:
    poses = poses_of(together[0])
    assert set(poses) == {0, 1, 2, 3}
    assert spread(poses, truth_of(room)) < 0.012


def test_the_map_stands_in_the_frame_of_all_priors_together(
    room: Room, together: tuple[MapRegistration, list[tuple[str, float]]]
) -> None:
    """No prior is nearer than 10 cm and 2 degrees, but they are off in opposite directions."""
    for number, pose in poses_of(together[0]).items():
        assert off(pose, room.before[number].world_from_sensor) < 0.07


def test_every_scan_has_its_numbers_its_uncertainty_and_its_path(
    together: tuple[MapRegistration, list[tuple[str, float]]],
) -> None:
    found, _ = together
    reference = found.report.reference
    for number, outcome in enumerate(found.outcomes):
        each = registered(outcome)
        assert (outcome.fitness, outcome.inlier_rmse) == (each.fitness, each.inlier_rmse)
        assert each.fitness is not None
        assert 0.3 < each.fitness <= 1
        assert each.inlier_rmse is not None
        assert 0 < each.inlier_rmse < 0.05
        assert each.overlap > 0.5
        assert each.two_way_inlier_ratio > 0.85
        assert not each.from_global_search
        assert each.uncertainty is not None
        assert 0.003 < each.uncertainty.translation < 0.02
        assert (each.path[0], each.path[-1]) == (reference, number)
        assert each.sensor_origin == pytest.approx(each.map_from_scan[:3, 3])


def test_the_report_counts_what_was_tried_and_what_the_map_rests_on(
    together: tuple[MapRegistration, list[tuple[str, float]]],
) -> None:
    found, _ = together
    report = found.report
    assert (report.scans, report.accepted, report.discarded) == (4, 4, 0)
    assert report.pairs_possible == 6
    assert 3 <= len(found.kept) <= report.pairs_accepted <= report.pairs_tried <= 6
    assert report.calls_saved == 1 - report.pairs_tried / 6
    assert report.pairs_contradicted == len(found.rejected) == 0
    assert report.mean_fitness == pytest.approx(np.mean([edge.fitness for edge in found.kept]))
    assert report.std_rmse == pytest.approx(np.std([edge.inlier_rmse for edge in found.kept]))


def test_each_stage_is_told_from_beginning_to_end_and_never_falls(
    together: tuple[MapRegistration, list[tuple[str, float]]],
) -> None:
    _, told = together
    assert list(dict.fromkeys(stage for stage, _ in told)) == ["reading", "registering", "refining"]
    for stage in ("reading", "registering", "refining"):
        shares = [share for name, share in told if name == stage]
        assert shares == sorted(shares)
        assert 0 <= shares[0] < 1
        assert shares[-1] == 1.0


def test_the_order_of_the_files_moves_no_scan_by_more_than_four_millimetres(
    drifted: tuple[ScanFile, ...], together: tuple[MapRegistration, list[tuple[str, float]]]
) -> None:
    order = (2, 0, 3, 1)
    again = poses_of(register([drifted[number] for number in order]))
    back = {number: again[at] for at, number in enumerate(order)}
    assert spread(back, poses_of(together[0])) < 0.004


def test_other_processes_give_the_same_poses(room: Room, drifted: tuple[ScanFile, ...], folder: Path) -> None:
    """Five scans: of four and fewer the caller takes care itself."""
    files = [
        written(folder / f"thin-{number}.pcd", scan, pose=scan.world_from_sensor, thinned=10)
        for number, scan in enumerate((*room.before, room.after[0]))
    ]
    alone, shared = (
        poses_of(register_map_scans(files, settings=PRIORS_ONLY, processes=count)) for count in (1, 2)
    )
    assert alone.keys() == shared.keys() == {0, 1, 2, 3, 4}
    assert max(off(alone[number], shared[number]) for number in alone) < 1e-6


def test_scans_without_any_prior_find_each_other_in_any_order(room: Room, folder: Path) -> None:
    order = (2, 0, 3, 1)
    files = [written(folder / f"lost-{number}.pcd", room.before[number]) for number in order]
    found = register(files, joint_settings(QUICK))
    poses = {number: registered(found.outcomes[at]).map_from_scan for at, number in enumerate(order)}
    assert spread(poses, truth_of(room)) < 0.012
    assert any(registered(outcome).from_global_search for outcome in found.outcomes)
    reference = found.report.reference
    assert reference is not None
    assert registered(found.outcomes[reference]).map_from_scan == pytest.approx(np.eye(4))


def test_one_scan_without_a_prior_finds_its_place_among_those_that_have_one(
    room: Room, drifted: tuple[ScanFile, ...], folder: Path
) -> None:
    lost = written(folder / "lost.pcd", room.before[2])
    found = register([*drifted[:2], lost], joint_settings(QUICK))
    poses = poses_of(found)
    assert set(poses) == {0, 1, 2}
    assert spread(poses, truth_of(room)) < 0.015
    assert off(poses[2], room.before[2].world_from_sensor) < 0.2  # the frame is that of a drifted prior


def test_a_scan_that_fits_only_to_another_that_comes_later_is_registered(room: Room, tmp_path: Path) -> None:
    """West and east of the room share nothing; the whole room, given last, ties them together."""
    east, whole, west = room.before[:3]
    files = [
        written(tmp_path / "west.pcd", west, between=(-np.inf, 2.3), pose=west.world_from_sensor),
        written(tmp_path / "east.pcd", east, between=(3.0, np.inf), pose=east.world_from_sensor),
        written(tmp_path / "whole.pcd", whole, pose=whole.world_from_sensor),
    ]
    assert len(poses_of(register(files[:2]))) == 1
    poses = poses_of(register(files))
    assert (
        spread(poses, {0: west.world_from_sensor, 1: east.world_from_sensor, 2: whole.world_from_sensor})
        < 0.03
    )
    assert set(poses) == {0, 1, 2}


def test_a_scan_that_no_pair_led_to_is_found_in_the_map_of_the_others(
    room: Room, drifted: tuple[ScanFile, ...], folder: Path
) -> None:
    """Its prior is 40 cm too high, which here keeps it from being paired with anybody."""
    scan = room.before[3]
    high = written(folder / "high.pcd", scan, pose=shifted(z=0.4) @ scan.world_from_sensor)
    settings = joint_settings(PRIORS_ONLY.registration, max_height_difference=0.2)
    told: list[tuple[str, float]] = []
    found = register([*drifted[:3], high], settings, progress=lambda *at: told.append(at))
    assert never_falls(told)  # though all are refined once more with the scan that was found
    assert spread(poses_of(found), truth_of(room)) < 0.012
    late = registered(found.outcomes[3])
    assert all(3 not in (edge.target, edge.source) for edge in found.kept)
    assert late.path[-1] == 3
    assert late.path[:-1] == registered(found.outcomes[late.path[-2]]).path
    assert late.fitness is not None
    assert late.uncertainty is not None
    assert late.uncertainty.translation < 0.02
    assert found.report.accepted == 4


# what has no place


def test_a_foreign_scan_is_left_out_with_a_reason_and_moves_no_other(
    drifted: tuple[ScanFile, ...],
    foreign: ScanFile,
    together: tuple[MapRegistration, list[tuple[str, float]]],
) -> None:
    found = register([drifted[0], foreign, *drifted[1:]], joint_settings(QUICK))
    assert [outcome.registration is not None for outcome in found.outcomes] == [True, False, True, True, True]
    stranger = found.outcomes[1]
    assert stranger.name == "foreign.pcd"
    assert stranger.reason is not None
    assert stranger.reason.startswith("scan foreign.pcd: ")
    assert stranger.fitness is not None
    assert 0 <= stranger.fitness < 0.9
    poses = poses_of(found)
    back = {number: poses[at] for number, at in enumerate((0, 2, 3, 4))}
    assert spread(back, poses_of(together[0])) < 0.002
    assert (found.report.accepted, found.report.discarded) == (4, 1)


def test_a_scan_whose_prior_is_astray_is_left_out_with_its_numbers(
    room: Room, drifted: tuple[ScanFile, ...], folder: Path
) -> None:
    astray = room.before[2].world_from_sensor @ shifted(2.5, yaw=np.pi / 2)
    found = register([*drifted[:2], written(folder / "astray.pcd", room.before[2], pose=astray)])
    assert set(poses_of(found)) == {0, 1}
    outcome = found.outcomes[2]
    assert outcome.reason is not None
    assert outcome.reason.startswith("scan astray.pcd: ")
    assert "is needed" in outcome.reason
    assert "check the pose prior" in outcome.reason  # to ask for one would be no help
    assert outcome.fitness is not None
    assert 0 < outcome.fitness < 1
    assert outcome.inlier_rmse is not None
    assert 0 < outcome.inlier_rmse < 0.05


def test_a_scan_with_a_board_where_its_neighbours_saw_nothing_is_left_out(
    room: Room, drifted: tuple[ScanFile, ...], folder: Path
) -> None:
    """The board is two in a hundred of its points: pair by pair that may pass, against all neighbours it does not."""
    scan = room.before[3]
    board = written(folder / "board.pcd", scan, pose=drifted[3].pose, more=hanging(scan, size=1.0))
    told: list[tuple[str, float]] = []
    found = register([*drifted[:3], board], progress=lambda *at: told.append(at))
    assert never_falls(told)  # though the others are refined once more without it
    assert set(poses_of(found)) == {0, 1, 2}
    assert found.outcomes[3].reason is not None
    assert found.outcomes[3].reason.startswith("scan board.pcd: ")
    assert "free space" in found.outcomes[3].reason
    assert all(3 not in (edge.target, edge.source) for edge in found.kept)


@pytest.mark.parametrize("place_of_it", [0, 1])
def test_a_file_that_is_no_scan_is_named_and_left_out(
    drifted: tuple[ScanFile, ...], tmp_path: Path, place_of_it: int
) -> None:
    (tmp_path / "x.bin").write_bytes(b"nothing like a scan")
    files = [*drifted[:2]]
    files.insert(place_of_it, ScanFile(name="broken scan.ply", path=tmp_path / "x.bin"))
    found = register(files)
    assert set(poses_of(found)) == {0, 1, 2} - {place_of_it}
    reason = found.outcomes[place_of_it].reason
    assert reason is not None
    assert reason.startswith("broken scan.ply: neither PLY, PCD, E57 nor LAS")


def test_where_no_file_is_a_scan_the_first_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.bin").write_bytes(b"nothing like a scan")
    files = [ScanFile(name=name, path=tmp_path / "x.bin") for name in ("one.ply", "two.ply")]
    with pytest.raises(ScanError, match=r"^one\.ply: neither PLY, PCD, E57 nor LAS"):
        register(files)


def test_a_scan_of_more_points_than_the_limit_is_refused(drifted: tuple[ScanFile, ...]) -> None:
    few = JointRegistrationSettings(registration=QUICK, mapping=MappingSettings(), max_points=1000)
    with pytest.raises(ScanTooLarge, match=r"^drifted-0\.pcd: "):
        register(drifted[:1], few)


def bare_plane(path: Path) -> ScanFile:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-4, 4, (40_000, 2)), rng.normal(-0.4, 0.015, 40_000)])
    write_pcd(path, plane.astype(np.float32))
    return ScanFile(name=path.name, path=path)


def test_a_bare_plane_makes_no_map(tmp_path: Path) -> None:
    with pytest.raises(MapFailed, match=r"plane\.pcd: its surfaces leave a motion free"):
        register([bare_plane(tmp_path / "plane.pcd")])


def test_where_nothing_holds_a_pose_every_reason_is_told(tmp_path: Path) -> None:
    (tmp_path / "x.bin").write_bytes(b"nothing like a scan")
    files = [bare_plane(tmp_path / "plane.pcd"), ScanFile(name="x.ply", path=tmp_path / "x.bin")]
    with pytest.raises(
        MapFailed, match=r"plane\.pcd: its surfaces leave.*; x\.ply: neither PLY, PCD, E57 nor LAS"
    ):
        register(files)


def test_a_bare_plane_among_sound_scans_is_left_out_with_its_reason(
    drifted: tuple[ScanFile, ...], tmp_path: Path
) -> None:
    found = register([bare_plane(tmp_path / "plane.pcd"), drifted[0]])
    assert set(poses_of(found)) == {1}
    assert "leave a motion free" in str(found.outcomes[0].reason)
    assert poses_of(found)[1] == pytest.approx(drifted[0].pose)


# being stopped


@pytest.mark.parametrize("last", ["reading", "registering", "refining"])
def test_a_dismissal_stops_any_stage(drifted: tuple[ScanFile, ...], last: str) -> None:
    told: list[str] = []

    def dismissed(stage: str, share: float) -> None:
        told.append(stage)
        if stage == last:
            raise Cancelled("the job was dismissed")

    with pytest.raises(Cancelled):
        register(drifted[:2], progress=dismissed)
    assert told[-1] == last
    assert told.count(last) == 1


# true causes


def test_a_mirrored_scan_of_a_map_is_refused_as_mirrored(
    room: Room, drifted: tuple[ScanFile, ...], folder: Path
) -> None:
    scan = room.before[1]
    write_pcd(folder / "mirrored.pcd", (scan.points * [-1, 1, 1]).astype(np.float32))
    sent = [drifted[0], drifted[2], drifted[3], ScanFile(name="mirrored.pcd", path=folder / "mirrored.pcd")]
    found = register(sent, joint_settings(QUICK))
    assert [outcome.registration is not None for outcome in found.outcomes] == [True, True, True, False]
    diagnosis = found.outcomes[3].diagnosis
    assert diagnosis is not None
    assert diagnosis.reason == "mirrored"


def test_a_scan_of_a_map_whose_prior_is_kilometres_off_is_told_so(
    room: Room, drifted: tuple[ScanFile, ...]
) -> None:
    away = shifted(5000.0, 0.0) @ room.before[3].world_from_sensor
    found = register([*drifted[:3], replace(drifted[3], pose=away)])
    diagnosis = found.outcomes[3].diagnosis
    assert diagnosis is not None
    assert diagnosis.reason == "wrong_prior"
    assert "5.0 km" in diagnosis.detail


def test_a_prior_a_hundred_thousand_kilometres_off_is_told_with_its_distance(
    room: Room, drifted: tuple[ScanFile, ...]
) -> None:
    away = shifted(1e8, 0.0) @ room.before[3].world_from_sensor
    found = register([*drifted[:3], replace(drifted[3], pose=away)])
    assert [outcome.registration is not None for outcome in found.outcomes] == [True, True, True, False]
    diagnosis = found.outcomes[3].diagnosis
    assert diagnosis is not None
    assert diagnosis.reason == "wrong_prior"
    assert "over 10,000 km" in diagnosis.detail
    assert diagnosis.numbers["outside"] == pytest.approx(1e8, rel=1e-3)


def test_a_scan_of_a_map_with_y_up_is_turned_and_told(
    room: Room, drifted: tuple[ScanFile, ...], folder: Path
) -> None:
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # y, -z become z, y
    scan = room.before[1]
    write_pcd(folder / "y-up.pcd", (scan.points @ y_up.T).astype(np.float32))
    pose = scan.world_from_sensor.copy()
    pose[:3, :3] = pose[:3, :3] @ y_up.T
    sent = [drifted[0], drifted[2], ScanFile(name="y-up.pcd", path=folder / "y-up.pcd", pose=pose)]
    found = register(sent)
    assert [tuple(warning.reason for warning in outcome.warnings) for outcome in found.outcomes] == [
        (),
        (),
        ("other_up_axis",),
    ]
