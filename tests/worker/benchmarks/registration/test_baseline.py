"""The Open3D baseline: which pairs it runs, what it makes of them, and what it costs."""

from __future__ import annotations

from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest

from worker.benchmarks.registration.baseline import (
    BaselineEdge,
    BaselineSettings,
    build_baseline,
    chosen_pairs,
    compare,
    optimised,
)
from worker.benchmarks.registration.scenarios import ScenarioSettings, scenario, take_walk
from worker.benchmarks.trajectory import align, distances
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.simulation.scenes import rigid

SQUARE = [rigid(0.0, 0.0), rigid(4.0, 0.0, yaw=90.0), rigid(4.0, 4.0, yaw=180.0), rigid(0.0, 4.0, yaw=270.0)]


def edge(i: int, j: int, i_from_j: Matrix4 | None = None) -> BaselineEdge:
    true = inverse(SQUARE[i]) @ SQUARE[j]
    return BaselineEdge(
        pair=(i, j),
        i_from_j=true if i_from_j is None else i_from_j,
        information=1000 * np.eye(6),
    )


def test_all_pairs_of_42_scans_are_861() -> None:
    always, rest = chosen_pairs(42, BaselineSettings())
    assert (len(always), len(rest)) == (0, 861)


def test_a_sample_takes_the_named_pairs_and_so_many_of_the_rest() -> None:
    named = frozenset({(0, 1), (5, 9)})
    always, rest = chosen_pairs(42, BaselineSettings(sample=30, always=named, seed=1))
    assert set(always) == named
    assert len(set(rest) - named) == 30
    assert rest == chosen_pairs(42, BaselineSettings(sample=30, always=named, seed=1))[1]
    assert rest != chosen_pairs(42, BaselineSettings(sample=30, always=named, seed=2))[1]


def test_the_graph_undoes_drift_and_leaves_a_scan_without_edges_out() -> None:
    rng = np.random.default_rng(0)
    priors = [pose @ rigid(*rng.uniform(-0.2, 0.2, 2).tolist(), yaw=2.0) for pose in SQUARE]
    poses = optimised([edge(0, 1), edge(1, 2)], priors)
    assert sorted(poses) == [0, 1, 2]
    for i, j in pairwise(sorted(poses)):
        apart = difference(inverse(poses[i]) @ poses[j], inverse(SQUARE[i]) @ SQUARE[j])
        assert apart == pytest.approx((0.0, 0.0), abs=1e-4)


def test_a_wrong_loop_is_outvoted() -> None:
    wrong = edge(0, 2, inverse(SQUARE[0]) @ SQUARE[2] @ rigid(3.0))
    poses = optimised([edge(0, 1), edge(1, 2), edge(2, 3), edge(0, 3), wrong], SQUARE)
    assert distances(align(list(poses.values()), SQUARE), list(poses.values()), SQUARE).max() < 0.01


def test_four_scans_of_a_room_come_out_right_from_drifted_priors(tmp_path: Path) -> None:
    walk = ScenarioSettings(building="room", scans=4, foreign=1, seed=3, duration_s=2.0)
    given = scenario(take_walk(walk, tmp_path), "drifted", seed=3)
    true = [pose for pose in given.true if pose is not None]
    found = build_baseline(given.files, BaselineSettings())
    assert found.pairs_run == found.pairs_possible == 6
    assert sorted(found.poses) == [0, 1, 2, 3]
    assert min(found.seconds.values()) > 0
    ours = {at: pose @ rigid(yaw=0.0) for at, pose in enumerate(true)}  # as good as a map can be
    compared = compare(found, ours, frozenset(combinations(range(4), 2)), true)
    assert compared["pairs_wrong"] == compared["our_pairs_wrong"] == 0
    assert compared["common"]["pairs"] == len(found.edges) >= 3
    assert compared["to_the_truth"]["centimetres"]["worst"] < 5


def test_files_without_priors_are_refused(tmp_path: Path) -> None:
    walk = ScenarioSettings(building="room", scans=2, foreign=1, duration_s=0.1)
    given = scenario(take_walk(walk, tmp_path), "lost", seed=1)
    with pytest.raises(ValueError, match="priors"):
        build_baseline(given.files, BaselineSettings())
