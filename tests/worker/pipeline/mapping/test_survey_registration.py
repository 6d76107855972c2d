"""Scans of a second visit on the map of the first; every pose is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room
from tests.support.walks import (
    QUICK,
    corridor_points,
    hanging,
    joint_settings,
    never_falls,
    off,
    registered,
    written,
)
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.formats.scan import read_scan
from worker.cloud.sight import Sights
from worker.cloud.voxels import Voxels
from worker.errors import Cancelled, ScanError, ScanTooLarge
from worker.pipeline.mapping.settings import JointRegistrationSettings
from worker.pipeline.mapping.survey_registration import SurveyRegistration, register_survey_scans
from worker.pipeline.registration.results import ScanFile, ScanResult
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface, surface_of
from worker.progress import Progress, no_progress
from worker.simulation.scenes import random_room, refurnished
from worker.simulation.visits import visit

#: without any search, so that a prior has to do
PRIORS_ONLY = joint_settings(QUICK.model_copy(update={"search_resolutions": ()}))
#: metres along x, between which this part of the room lies
WEST, EAST = (-np.inf, 2.3), (3.0, np.inf)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scans")


@pytest.fixture(scope="module")
def files(room: Room, folder: Path) -> tuple[ScanFile, ...]:
    """Two scans of the second visit and one of the first; priors are off by 15 cm and 2 degrees."""
    drift = shifted(0.12, -0.09, yaw=np.radians(2))
    return tuple(
        written(folder / f"now-{number}.pcd", scan, pose=scan.world_from_sensor @ drift)
        for number, scan in enumerate((*room.after, room.before[2]))
    )


@pytest.fixture(scope="module")
def west(room: Room) -> Surface:
    """A map of the room's western part alone."""
    scan = room.before[2]
    points = scan.world_points[scan.world_points[:, 0] < WEST[1]]
    voxels = Voxels.of(points, size=0.05, origin=scan.world_from_sensor[:3, 3])
    return surface_of(voxels, RegistrationSettings())


def register(
    files: Sequence[ScanFile],
    target: Surface,
    settings: JointRegistrationSettings = PRIORS_ONLY,
    *,
    growing: bool = False,
    progress: Progress = no_progress,
) -> tuple[ScanResult, ...]:
    return register_survey_scans(
        files, target, settings=settings, growing=growing, progress=progress
    ).outcomes


@pytest.fixture(scope="module")
def together(
    room: Room, files: tuple[ScanFile, ...]
) -> tuple[tuple[ScanResult, ...], list[tuple[str, float]]]:
    """All three registered at once, and what was told on the way."""
    told: list[tuple[str, float]] = []
    return register(files, room.target, progress=lambda *at: told.append(at)), told


def stages(told: list[tuple[str, float]]) -> list[str]:
    return list(dict.fromkeys(stage for stage, _ in told))


def test_one_scan_stands_where_it_fits_the_map_and_tells_how_sure_that_is(
    room: Room, files: tuple[ScanFile, ...]
) -> None:
    told: list[tuple[str, float]] = []
    (outcome,) = register(files[:1], room.target, progress=lambda *at: told.append(at))
    found = registered(outcome)
    assert off(found.map_from_scan, room.after[0].world_from_sensor) < 0.012
    assert found.sensor_origin == pytest.approx(found.map_from_scan[:3, 3])
    assert found.uncertainty is not None
    assert 0.003 < found.uncertainty.translation < 0.02
    assert 0.0004 < found.uncertainty.rotation < 0.01
    assert (outcome.fitness, outcome.inlier_rmse) == (found.fitness, found.inlier_rmse)
    assert stages(told) == ["registering"]
    assert told[-1] == ("registering", 1.0)
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert len(set(shares)) > 10  # it moves while the one scan is registered
    assert sum(0.1 < share < 0.85 for share in shares) > 10


def test_several_scans_are_refined_together_against_the_map(
    room: Room, together: tuple[tuple[ScanResult, ...], list[tuple[str, float]]]
) -> None:
    outcomes, told = together
    for outcome, scan in zip(outcomes, (*room.after, room.before[2]), strict=True):
        found = registered(outcome)
        assert off(found.map_from_scan, scan.world_from_sensor) < 0.012
        assert found.uncertainty is not None
        assert 0.003 < found.uncertainty.translation < 0.02
        assert found.sensor_origin == pytest.approx(found.map_from_scan[:3, 3])
    assert stages(told) == ["registering", "refining"]
    for stage in ("registering", "refining"):
        shares = [share for at, share in told if at == stage]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


def test_scans_that_agree_move_each_other_by_millimetres_only(
    room: Room,
    files: tuple[ScanFile, ...],
    together: tuple[tuple[ScanResult, ...], list[tuple[str, float]]],
) -> None:
    for outcome, file in list(zip(together[0], files, strict=True))[1:]:
        (alone,) = register([file], room.target)
        moved = off(registered(outcome).map_from_scan, registered(alone).map_from_scan)
        assert 0 < moved < 0.006


def test_a_scan_that_sees_a_board_where_the_others_saw_nothing_is_left_out_and_named(
    room: Room, files: tuple[ScanFile, ...], folder: Path
) -> None:
    """A board of 1.8 m square: eight in a hundred of its points stand in what the others saw as free."""
    scan = room.after[1]
    odd = written(folder / "odd.pcd", scan, pose=scan.world_from_sensor, more=hanging(scan, size=1.8))
    alone = register([odd], room.target)
    assert alone[0].registration is not None  # the map alone would have it
    told: list[tuple[str, float]] = []
    outcomes = register([files[0], odd, files[2]], room.target, progress=lambda *at: told.append(at))
    assert never_falls(told)
    assert [outcome.registration is not None for outcome in outcomes] == [True, False, True]
    assert outcomes[1].reason is not None
    assert outcomes[1].reason.startswith("scan odd.pcd: it disagrees with the other scans")
    assert outcomes[1].fitness is not None
    assert outcomes[1].fitness > 0.3
    without = register([files[0], files[2]], room.target)
    for number, other in ((0, 0), (2, 1)):
        a, b = registered(outcomes[number]), registered(without[other])
        assert off(a.map_from_scan, b.map_from_scan) < 0.001


def test_a_scan_that_the_others_would_have_elsewhere_is_left_out_and_named(folder: Path) -> None:
    """A map of a bare corridor lets scans slide; the end walls that they saw say that one is a decimetre off."""
    stays = {"min_eigenvalue": 0.0, "coarse_distances": (), "max_iterations": 2}
    lenient = joint_settings(PRIORS_ONLY.registration.model_copy(update=stays))
    bare = Voxels.of(corridor_points(ends=False, seed=9, half=8.0), size=0.05, origin=np.zeros(3))
    target = surface_of(bare, lenient.registration)
    files = []
    for number, off_by in enumerate((0.0, 0.13, 0.0)):
        path = folder / f"corridor-{number}.pcd"
        write_pcd(path, corridor_points(ends=True, seed=number))
        files.append(ScanFile(name=path.name, path=path, pose=shifted(off_by)))
    outcomes = register(files, target, lenient)
    assert [outcome.registration is not None for outcome in outcomes] == [True, False, True]
    assert outcomes[1].reason is not None
    assert outcomes[1].reason.startswith("scan corridor-1.pcd: it disagrees with the other scans")
    assert any(f"would have it {centimetres} cm from" in outcomes[1].reason for centimetres in range(6, 13))
    for outcome in (outcomes[0], outcomes[2]):
        assert off(registered(outcome).map_from_scan, np.eye(4)) < 0.03


def test_of_two_scans_that_disagree_and_are_believed_alike_both_are_left_out_and_named(folder: Path) -> None:
    stays = {"min_eigenvalue": 0.0, "coarse_distances": (), "max_iterations": 2}
    lenient = joint_settings(PRIORS_ONLY.registration.model_copy(update=stays))
    bare = Voxels.of(corridor_points(ends=False, seed=9, half=8.0), size=0.05, origin=np.zeros(3))
    target = surface_of(bare, lenient.registration)
    files = []
    for number, off_by in enumerate((0.0, 0.13)):
        path = folder / f"tie-{number}.pcd"
        write_pcd(path, corridor_points(ends=True, seed=number))
        files.append(ScanFile(name=path.name, path=path, pose=shifted(off_by)))
    outcomes = register(files, target, lenient)
    assert [outcome.registration for outcome in outcomes] == [None, None]
    assert all(outcome.diagnosis and outcome.diagnosis.reason == "disagrees" for outcome in outcomes)
    assert all(file.name in str(outcome.reason) for file, outcome in zip(files, outcomes, strict=True))


def test_a_foreign_scan_is_left_out_and_moves_no_other(
    room: Room, files: tuple[ScanFile, ...], folder: Path
) -> None:
    foreign = written(folder / "foreign.pcd", visit(random_room(11), 1, seed=5)[0])
    outcomes = register([files[0], foreign, files[1]], room.target)
    assert [outcome.registration is not None for outcome in outcomes] == [True, False, True]
    assert outcomes[1].reason is not None
    assert outcomes[1].reason.startswith("scan foreign.pcd: ")
    assert "is needed" in outcomes[1].reason
    assert (outcomes[1].fitness is not None, outcomes[1].name) == (True, "foreign.pcd")
    without = register(files[:2], room.target)
    for number, other in ((0, 0), (2, 1)):
        a, b = registered(outcomes[number]), registered(without[other])
        assert a.map_from_scan.tolist() == b.map_from_scan.tolist()


def test_a_scan_without_a_prior_is_searched(room: Room, folder: Path) -> None:
    lost = written(folder / "lost.pcd", room.after[0])
    (outcome,) = register([lost], room.target, joint_settings(QUICK))
    assert registered(outcome).from_global_search
    assert off(registered(outcome).map_from_scan, room.after[0].world_from_sensor) < 0.012


def test_a_survey_without_any_place_has_a_reason_for_every_scan_and_no_placement(
    room: Room, folder: Path
) -> None:
    out_of_place = [
        written(folder / f"stranger-{number}.pcd", scan)
        for number, scan in enumerate(visit(random_room(11), 2, seed=5))
    ]
    outcomes = register(out_of_place, room.target)
    assert [outcome.registration for outcome in outcomes] == [None, None]
    assert all(str(outcome.reason).startswith(f"scan {outcome.name}: ") for outcome in outcomes)


# a map that is to grow


def test_a_scan_that_touches_only_another_new_one_is_registered_where_the_map_is_to_grow(
    room: Room, west: Surface, folder: Path
) -> None:
    """The map knows the west; one scan saw the whole room, the other its east alone."""
    whole, east = room.before[1], room.before[0]
    files = [
        written(folder / "east.pcd", east, between=EAST, pose=east.world_from_sensor),
        written(folder / "whole.pcd", whole, pose=whole.world_from_sensor),
    ]
    survey = register(files, west)
    assert [outcome.registration is not None for outcome in survey] == [False, True]
    told: list[tuple[str, float]] = []
    grown = register(files, west, growing=True, progress=lambda *at: told.append(at))
    assert never_falls(told)
    for outcome, scan in zip(grown, (east, whole), strict=True):
        assert off(registered(outcome).map_from_scan, scan.world_from_sensor) < 0.03


def test_what_finds_no_place_in_the_grown_map_either_is_left_out(
    room: Room, west: Surface, folder: Path
) -> None:
    whole = room.before[1]
    foreign = written(folder / "foreign-2.pcd", visit(random_room(11), 1, seed=5)[0])
    files = [foreign, written(folder / "whole-2.pcd", whole, pose=whole.world_from_sensor)]
    outcomes = register(files, west, growing=True)
    assert [outcome.registration is not None for outcome in outcomes] == [False, True]
    assert str(outcomes[0].reason).startswith("scan foreign-2.pcd: ")


# files


@pytest.mark.parametrize("place_of_it", [0, 1])
def test_a_file_that_is_no_scan_is_left_out_with_its_reason(
    room: Room, files: tuple[ScanFile, ...], tmp_path: Path, place_of_it: int
) -> None:
    (tmp_path / "x").write_bytes(b"ply\nbut no more")
    asked = [files[0]]
    asked.insert(place_of_it, ScanFile(name="hall 3.ply", path=tmp_path / "x"))
    outcomes = register(asked, room.target)
    assert outcomes[place_of_it].registration is None
    assert str(outcomes[place_of_it].reason).startswith("hall 3.ply: ")
    assert registered(outcomes[1 - place_of_it]).fitness is not None


def test_where_no_file_is_a_scan_the_first_is_named(room: Room, tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"ply\nbut no more")
    asked = [ScanFile(name=name, path=tmp_path / "x") for name in ("one.ply", "two.ply")]
    with pytest.raises(ScanError, match=r"^one\.ply: "):
        register(asked, room.target)


def test_a_scan_of_more_points_than_the_limit_is_refused(room: Room, files: tuple[ScanFile, ...]) -> None:
    few = JointRegistrationSettings(
        registration=PRIORS_ONLY.registration, mapping=PRIORS_ONLY.mapping, max_points=1000
    )
    with pytest.raises(ScanTooLarge, match=r"^now-0\.pcd: "):
        register(files[:1], room.target, few)


@pytest.mark.parametrize("last", ["registering", "refining"])
def test_a_dismissal_stops_within_one_step(room: Room, files: tuple[ScanFile, ...], last: str) -> None:
    told: list[str] = []

    def dismissed(stage: str, share: float) -> None:
        told.append(stage)
        if told.count(last) == 2:
            raise Cancelled("the job was dismissed")

    with pytest.raises(Cancelled):
        register(files[:2], room.target, progress=dismissed)
    assert told.count(last) == 2
    assert told[-1] == last


# --- with what the map's scans saw


@pytest.fixture(scope="module")
def sights(room: Room) -> Sights | None:
    return Sights.of((scan.world_points, scan.world_from_sensor[:3, 3]) for scan in room.before)


@pytest.fixture(scope="module")
def strange(folder: Path) -> ScanFile:
    """A scan of the very same shell with all other furniture, its prior as right as that of the others."""
    (scan,) = visit(refurnished(random_room(3), seed=5), 1, seed=11)
    return written(folder / "strange.pcd", scan, pose=scan.world_from_sensor)


def surveyed(
    files: Sequence[ScanFile], room: Room, sights: Sights | None, *, processes: int = 1, growing: bool = False
) -> SurveyRegistration:
    return register_survey_scans(
        files,
        room.target,
        sights=sights,
        settings=joint_settings(),
        processes=processes,
        growing=growing,
    )


def test_right_scans_are_confirmed_with_a_confidence(
    room: Room, files: tuple[ScanFile, ...], sights: Sights | None
) -> None:
    found = surveyed(files, room, sights)
    assert found.placement.confidence is not None
    assert found.placement.confidence > 0.95
    assert not found.placement.in_doubt
    assert all((outcome.confidence or 0.0) > 0.9 for outcome in found.outcomes)
    assert len(found.held) == len(files)


def test_without_what_the_map_saw_and_scans_whose_place_is_known_their_own_rays_speak(
    room: Room, files: tuple[ScanFile, ...]
) -> None:
    found = surveyed(files[:1], room, None)
    assert found.placement.confidence is not None
    assert found.placement.confidence > 0.9


def test_a_scan_of_another_place_does_not_cost_the_others(
    room: Room, files: tuple[ScanFile, ...], strange: ScanFile, sights: Sights | None
) -> None:
    found = surveyed([files[0], strange, files[1]], room, sights)
    first, other, last = found.outcomes
    assert first.registration is not None
    assert last.registration is not None
    assert other.registration is None
    assert other.diagnosis is not None
    assert other.diagnosis.reason in ("other_place", "disagrees")
    assert not found.placement.in_doubt


def test_a_survey_of_another_place_alone_is_refused_or_in_doubt(
    room: Room, strange: ScanFile, sights: Sights | None
) -> None:
    found = surveyed([strange], room, sights)
    (outcome,) = found.outcomes
    assert outcome.registration is None or found.placement.in_doubt


def test_a_map_does_not_grow_by_a_scan_in_doubt(room: Room, strange: ScanFile, sights: Sights | None) -> None:
    (outcome,) = surveyed([strange], room, sights, growing=True).outcomes
    assert outcome.registration is None


def test_a_scan_with_a_wrong_prior_is_found_by_the_frame_of_the_others(
    room: Room, files: tuple[ScanFile, ...], sights: Sights | None
) -> None:
    """Two scans whose priors are 4 m off alike are sure of their place; a third one's search is told where to look."""
    away = shifted(4.0, 0.0)
    moved = [replace(file, pose=away @ file.pose) for file in files if file.pose is not None]
    found = surveyed(moved, room, sights)
    for outcome, scan in zip(found.outcomes, (*room.after, room.before[2]), strict=True):
        assert off(registered(outcome).map_from_scan, scan.world_from_sensor) < 0.02
        assert {warning.reason for warning in outcome.warnings} <= {"wrong_prior"}


def test_priors_that_are_all_farther_off_than_any_may_be_are_refused(
    room: Room, files: tuple[ScanFile, ...], sights: Sights | None
) -> None:
    away = shifted(9.0, 0.0)
    moved = [replace(file, pose=away @ file.pose) for file in files if file.pose is not None]
    found = surveyed(moved, room, sights)
    reasons = {outcome.diagnosis.reason for outcome in found.outcomes if outcome.diagnosis is not None}
    assert reasons == {"wrong_prior"}
    assert all(outcome.registration is None for outcome in found.outcomes)


def test_scans_are_registered_side_by_side_with_the_same_result(
    room: Room, files: tuple[ScanFile, ...], sights: Sights | None
) -> None:
    more = [replace(files[number % 3], name=f"scan-{number}") for number in range(6)]
    alone, beside = surveyed(more, room, sights), surveyed(more, room, sights, processes=2)
    for one, other in zip(alone.outcomes, beside.outcomes, strict=True):
        assert off(registered(one).map_from_scan, registered(other).map_from_scan) < 1e-3
        assert one.confidence == pytest.approx(other.confidence, abs=0.02)


def test_a_mirrored_scan_is_named_as_one(room: Room, folder: Path, sights: Sights | None) -> None:
    scan = room.after[0]
    path = folder / "mirrored.pcd"
    write_pcd(path, scan.points * np.array([-1, 1, 1], np.float32))
    (outcome,) = surveyed([ScanFile(name=path.name, path=path)], room, sights).outcomes
    assert outcome.diagnosis is not None
    assert outcome.diagnosis.reason == "mirrored"


def test_a_prior_kilometres_outside_the_map_is_blamed_with_the_distance(
    room: Room, files: tuple[ScanFile, ...], sights: Sights | None
) -> None:
    pose = files[0].pose
    assert pose is not None
    (outcome,) = surveyed([replace(files[0], pose=shifted(5000.0, 0.0) @ pose)], room, sights).outcomes
    assert outcome.diagnosis is not None
    assert outcome.diagnosis.reason == "wrong_prior"
    assert "5.0 km" in outcome.diagnosis.detail
    assert outcome.diagnosis.numbers["outside"] == pytest.approx(5000, abs=20)


def test_a_scan_of_another_room_with_a_prior_outside_the_map_is_told_of_the_prior(
    room: Room, strange: ScanFile, sights: Sights | None
) -> None:
    (outcome,) = surveyed([replace(strange, pose=shifted(1e8, 0.0))], room, sights).outcomes
    assert outcome.diagnosis is not None
    assert outcome.diagnosis.reason == "wrong_prior"
    assert "outside the map, and it was found nowhere else in the map" in outcome.diagnosis.detail


def test_what_is_odd_about_a_file_goes_with_its_outcome_accepted_or_not(
    room: Room, files: tuple[ScanFile, ...], strange: ScanFile, folder: Path, sights: Sights | None
) -> None:
    sent = []
    for file in (files[0], strange):
        points = read_scan(file.path).points.copy()
        points[100] = 5000, 30, 1
        path = folder / f"stray-{file.name}"
        write_pcd(path, points)
        sent.append(replace(file, name=path.name, path=path))
    found = surveyed(sent, room, sights).outcomes
    assert [outcome.registration is not None for outcome in found] == [True, False]
    for outcome in found:
        (warning,) = [one for one in outcome.warnings if one.reason == "far_points"]
        assert "1 points far from all others were left out, the farthest 5.0 km away" in warning.detail
