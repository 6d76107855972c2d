"""Two lines of scans that agree within themselves, laid over each other by a registration that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.graphs import along, edge, line, shifted
from tests.support.rooms import Room
from tests.support.walks import QUICK, joint_settings, prepared_folder, spread, written
from worker.cloud.poses import exponential
from worker.pipeline.mapping import map_registration as stage
from worker.pipeline.mapping.outlier_rejection import find_violations, most_voted
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.mapping.tasks import Violation, Workspace
from worker.pipeline.registration.scan_to_scan import PairResult
from worker.processes import Processes

SETTINGS = MappingSettings()


def two_lines() -> tuple[list[int], list[PairResult], PairResult]:
    """Scans 0 to 4 and 5 to 9, each a line, and the edge 2-7 that ties them."""
    truth = line(5)
    second = {number + 5: pose for number, pose in line(5).items()}
    bridge = edge(truth | second, 2, 7, error=shifted(0.5), two_way_inlier_ratio=0.88)
    return [*truth, *second], [*along(truth), *along(second), bridge], bridge


def violations(*pairs: tuple[int, int]) -> list[Violation]:
    return [Violation(target=a, source=b, share=0.03) for a, b in pairs]


def test_the_edge_between_groups_that_contradict_each_other_is_accused() -> None:
    scans, edges, bridge = two_lines()
    found = violations((0, 5), (1, 6), (3, 8), (4, 9))
    assert most_voted(scans, edges, found, SETTINGS) is bridge


def test_a_contradiction_within_a_group_accuses_no_edge_between_groups() -> None:
    scans, edges, bridge = two_lines()
    accused = most_voted(scans, edges, violations((0, 4)), SETTINGS)
    assert accused is not None
    assert accused is not bridge


def test_the_more_doubtful_of_two_edges_on_a_path_is_accused() -> None:
    truth = line(4)
    sure, doubtful = (
        edge(truth, 0, 1),
        edge(truth, 1, 2, two_way_inlier_ratio=0.86, free_space_violation=0.001),
    )
    edges = [sure, doubtful, edge(truth, 2, 3)]
    assert most_voted(list(truth), edges, violations((0, 3)), SETTINGS) is doubtful


def test_without_a_contradiction_nobody_is_accused() -> None:
    scans, edges, _ = two_lines()
    assert most_voted(scans, edges, [], SETTINGS) is None


@pytest.mark.slow
def test_a_scan_turned_about_in_its_room_contradicts_the_others_and_nobody_else_does(
    room: Room, tmp_path: Path
) -> None:
    folder, points = prepared_folder(tmp_path, dict(enumerate(room.before)))
    workspace = Workspace(folder=folder, processes=Processes(None), settings=joint_settings(QUICK))
    truth = {number: scan.world_from_sensor for number, scan in enumerate(room.before)}
    half_turn = exponential(np.array([0.0, 0.0, np.pi / 2, 1.0, 0.5, 0.0]))
    wrong = truth | {2: truth[2] @ half_turn}

    def found(poses: dict[int, np.ndarray]) -> list[Violation]:
        return find_violations(poses, points, workspace)

    assert found(truth) == []
    assert {2 in (each.target, each.source) for each in found(wrong)} == {True}


@pytest.mark.slow
def test_an_accused_registration_is_solved_without_and_told_as_contradicted(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [
        written(tmp_path / f"{number}.pcd", scan, pose=scan.world_from_sensor)
        for number, scan in enumerate(room.before)
    ]
    accused: list[PairResult] = []

    def once(scans: object, edges: tuple[PairResult, ...], *_: object) -> PairResult | None:
        accused.extend(edges[:1] if not accused else [])
        return accused[0] if edges[0] is accused[0] else None

    monkeypatch.setattr(stage, "most_voted", once)
    found = stage.register_map_scans(files, settings=joint_settings(QUICK), processes=1)
    pair = (accused[0].target, accused[0].source)
    assert pair in {(each.target, each.source) for each in found.rejected}
    assert pair not in {(each.target, each.source) for each in found.kept}
    poses = {n: each.registration.map_from_scan for n, each in enumerate(found.outcomes) if each.registration}
    assert len(poses) == len(files)
    assert spread(poses, {n: scan.world_from_sensor for n, scan in enumerate(room.before)}) < 0.03
