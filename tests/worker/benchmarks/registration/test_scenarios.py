"""What a map is built from, in each of the four kinds."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.registration.scenarios import (
    KINDS,
    ScenarioSettings,
    Walk,
    kinds_named,
    scenario,
    take_walk,
)
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import difference, transformed
from worker.simulation.scenes import random_room
from worker.simulation.visits import DRIFT

SETTINGS = ScenarioSettings(building="room", scans=6, foreign=3, seed=2, duration_s=0.2)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    return take_walk(SETTINGS, tmp_path_factory.mktemp("walk"))


def test_files_hold_the_points_in_the_sensor_frame_of_the_true_pose(walk: Walk) -> None:
    scene = random_room(2)
    assert len(walk.scans) == 6
    for taken in walk.scans:
        assert taken.path is not None
        scan = read_scan(taken.path)
        assert np.array_equal(scan.sensor_pose, np.eye(4))
        # the range noise alone, and the veils at edges
        assert np.median(scene.caster.distances(transformed(scan.points, taken.world_from_sensor))) < 0.02


def test_out_of_place_scans_come_with_priors_among_the_walk(walk: Walk) -> None:
    names = [taken.path.stem for taken in walk.out_of_place if taken.path]
    assert names == ["foreign-1", "foreign-2", "foreign-3"]
    stops = np.array([taken.world_from_sensor[:2, 3] for taken in walk.scans])
    for taken in walk.out_of_place:
        assert np.linalg.norm(stops - taken.prior[:2, 3], axis=1).min() <= DRIFT[0]


def test_drifted_keeps_the_order_and_gives_priors_within_the_drift(walk: Walk) -> None:
    given = scenario(walk, "drifted", seed=2)
    assert [file.name for file in given.files] == [f"stop-{number:02d}" for number in range(1, 7)]
    for file, true in zip(given.files, given.true, strict=True):
        assert true is not None and file.pose is not None
        metres, radians = difference(true, file.pose)
        assert 0 < metres <= np.hypot(DRIFT[0], DRIFT[0] / 10)
        assert np.degrees(radians) <= DRIFT[1]


def test_lost_shuffles_and_tells_nothing_and_truth_stays_with_its_file(walk: Walk) -> None:
    given = scenario(walk, "lost", seed=2)
    names = [file.name for file in given.files]
    assert names != sorted(names)
    assert all(file.pose is None for file in given.files)
    poses = {taken.path.stem: taken.world_from_sensor for taken in walk.scans if taken.path}
    for file, true in zip(given.files, given.true, strict=True):
        assert true is poses[file.name]


@pytest.mark.parametrize("kind", KINDS)
def test_out_of_place_scans_are_where_the_kind_says(walk: Walk, kind) -> None:
    given = scenario(walk, kind, seed=2)
    assert sum(true is None for true in given.true) == (3 if kind.endswith("foreign") else 0)
    assert sum(true is not None for true in given.true) == 6


def test_kinds_are_named_with_commas() -> None:
    assert kinds_named("lost, drifted+foreign") == ("lost", "drifted+foreign")
    assert kinds_named("none") == ()
    with pytest.raises(ValueError, match="no scenario tilted; there are drifted"):
        kinds_named("drifted,tilted")
