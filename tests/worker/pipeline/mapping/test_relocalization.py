from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.graphs import shifted
from tests.support.rooms import Room, as_scan
from tests.support.walks import QUICK, joint_settings, off, prepared_folder
from worker.cloud.poses import inverse
from worker.cloud.types import Matrix4
from worker.pipeline.mapping.relocalization import Relocalized, relocalize
from worker.pipeline.mapping.tasks import ValidScan, Workspace, forget_loaded, lay_together
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.settings import RegistrationSettings
from worker.processes import Processes
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

LEFT = 3  #: the scan that is left over
AWAY = shifted(20.0, -7.0, yaw=0.6)  #: the frame of the priors, from that of the reference scan


@pytest.fixture
def work(room: Room, tmp_path: Path) -> Workspace:
    """Four scans of the room, prepared; what was loaded from another test's folder is forgotten."""
    forget_loaded()
    folder, _ = prepared_folder(tmp_path, dict(enumerate(room.before)))
    settings = joint_settings(QUICK.with_values(search_resolutions=()))
    return Workspace(folder=folder, processes=Processes(None), settings=settings)


def truth(room: Room, number: int) -> Matrix4:
    """In the frame of scan 0."""
    return inverse(room.before[0].world_from_sensor) @ room.before[number].world_from_sensor


def looked_for(
    room: Room, work: Workspace, *, prior: Matrix4 | None, settings: RegistrationSettings | None = None
) -> Relocalized:
    """Scan LEFT in the map of the other three, whose priors are true in a frame far away."""
    poses = {number: truth(room, number) for number in range(LEFT)}
    scans = {
        number: ValidScan(points=as_scan(scan.points).points, prior=AWAY @ truth(room, number))
        for number, scan in enumerate(room.before[:LEFT])
    }
    scans[LEFT] = ValidScan(points=room.before[LEFT].points, prior=prior)
    asked = work if settings is None else replace(work, settings=joint_settings(settings))
    return relocalize([LEFT], poses, 0, scans, asked)[LEFT]


def test_nothing_missing_is_nothing_found(work: Workspace) -> None:
    assert relocalize([], {}, 0, {}, work) == {}


def test_a_scan_is_found_in_the_map_of_the_others_from_its_prior(room: Room, work: Workspace) -> None:
    prior = AWAY @ truth(room, LEFT) @ shifted(0.2, -0.1, yaw=0.05)
    found = looked_for(room, work, prior=prior)
    assert found.pose is not None
    assert off(found.pose, truth(room, LEFT)) < 0.015
    assert found.result.reason is None
    assert found.result.registration is not None
    assert found.result.registration.fitness is not None
    assert not found.result.registration.from_global_search


def test_a_scan_without_a_prior_is_searched_in_the_map_of_the_others(room: Room, work: Workspace) -> None:
    found = looked_for(room, work, prior=None, settings=QUICK)
    assert found.pose is not None
    assert off(found.pose, truth(room, LEFT)) < 0.015
    assert found.result.registration is not None
    assert found.result.registration.from_global_search


def test_it_stands_beside_the_registered_scan_that_is_nearest(room: Room, work: Workspace) -> None:
    found = looked_for(room, work, prior=AWAY @ truth(room, LEFT))
    apart = {number: off(truth(room, number), truth(room, LEFT)) for number in range(LEFT)}
    assert found.nearest == min(apart, key=lambda number: apart[number])


def test_a_scan_is_looked_for_in_the_map_as_it_has_grown_meanwhile(room: Room, work: Workspace) -> None:
    elsewhere = visit(random_room(11), 1, seed=5)[0]
    prepare(as_scan(elsewhere.points), QUICK).save(work.folder.path(9))
    scan = ValidScan(points=room.before[LEFT].points, prior=room.before[LEFT].world_from_sensor)
    truth = {number: room.before[number].world_from_sensor for number in (0, 1, 2)}
    scans = {LEFT: scan} | {
        n: ValidScan(points=room.before[n].points, prior=pose) for n, pose in truth.items()
    }
    alone = relocalize([LEFT], {9: truth[0]}, 9, {LEFT: scan, 9: scans[0]}, work)[LEFT]
    assert alone.pose is None
    assert relocalize([LEFT], truth, 0, scans, work)[LEFT].pose is not None


def test_a_foreign_scan_has_no_place_and_a_reason_with_numbers(room: Room, work: Workspace) -> None:
    foreign = prepare(as_scan(visit(random_room(11), 1, seed=5)[0].points, name="foreign.pcd"), QUICK)
    foreign.save(work.folder.path(LEFT))
    found = looked_for(room, work, prior=None, settings=QUICK)
    assert found.pose is None
    assert found.result.registration is None
    assert found.result.reason is not None
    assert found.result.reason.startswith("scan foreign.pcd: ")
    assert "is needed" in found.result.reason
    assert found.result.fitness is not None


@pytest.mark.parametrize("given", [True, False])
def test_a_place_that_its_neighbours_saw_through_is_no_place(
    room: Room, work: Workspace, given: bool
) -> None:
    """The neighbours are told to have seen half as far again: the scan's walls then stand in their free space."""
    for number in range(LEFT):
        scan = PreparedScan.load(work.folder.path(number))
        assert scan.image is not None
        farther = replace(scan.image, ranges=1.5 * scan.image.ranges)
        replace(scan, image=farther).save(work.folder.path(number))
    prior = AWAY @ truth(room, LEFT) if given else None
    found = looked_for(room, work, prior=prior, settings=QUICK)
    assert found.pose is None
    assert found.result.reason is not None
    assert "where its neighbours saw free space" in found.result.reason
    assert ("check its pose prior" in found.result.reason) == given
    assert ("give an initial pose" in found.result.reason) != given
    assert found.result.fitness is not None
    assert found.result.fitness > 0.5


def test_a_map_in_a_hurry_has_one_point_a_voxel_in_the_frame_of_the_poses(
    room: Room, work: Workspace
) -> None:
    poses = [(number, truth(room, number)) for number in range(2)]
    first, second = (work.folder.load(number).surface for number in range(2))
    surface = lay_together(work.folder, poses, voxel_size=0.05)
    assert len(first.points) < len(surface.points) < len(first.points) + len(second.points)
    assert surface.points[: len(first.points)] == pytest.approx(first.points)
    added = surface.points[len(first.points) :]
    there = second.points @ poses[1][1][:3, :3].T + poses[1][1][:3, 3]
    distance, index = surface.nearest(there, within=1e-6)
    assert (distance < 1e-6).sum() == len(added)
    whole = lay_together(work.folder, [poses[0], poses[0]], voxel_size=0.05)
    assert len(whole.points) == len(first.points)  # the same scan again adds nothing
    turned = second.normals @ poses[1][1][:3, :3].T
    hit = distance < 1e-6
    assert surface.normals[index[hit]] == pytest.approx(turned[hit], abs=1e-6)
