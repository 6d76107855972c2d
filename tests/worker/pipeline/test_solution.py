"""Graphs of known poses with errors of 5 mm and 0.06 degrees in each registration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from graphs import along, around, edge, line, ring, shifted

from worker.pipeline.map_settings import MapSettings
from worker.pipeline.pairwise import PairResult
from worker.pipeline.poses import difference, inverse
from worker.pipeline.solution import Solution, solve_graph
from worker.pipeline.values import Matrix4

SETTINGS = MapSettings()
DOUBTFUL = {"agreement": 0.84, "seen_through": 0.002}


def worst(found: Solution, truth: dict[int, Matrix4]) -> float:
    """Metres that a scan is off the truth at most, in the frame of the reference."""
    frame = inverse(truth[found.reference])
    return max(difference(pose, frame @ truth[number])[0] for number, pose in found.poses.items())


def apart(a: Solution, b: Solution) -> float:
    assert a.reference == b.reference
    assert set(a.poses) == set(b.poses)
    return max(difference(a.poses[number], b.poses[number])[0] for number in a.poses)


def pairs_of(edges: tuple[PairResult, ...] | list[PairResult]) -> set[tuple[int, int]]:
    return {(each.target, each.source) for each in edges}


def test_a_ring_of_scans_comes_to_a_centimetre() -> None:
    truth = ring(12)
    found = solve_graph(range(12), around(truth), SETTINGS)
    assert set(found.poses) == set(truth)
    assert worst(found, truth) < 0.015
    assert len(found.kept) == 24
    assert found.contradicted == ()


def test_a_registration_that_was_not_accepted_is_not_heard() -> None:
    truth = line(4)
    right = along(truth, reach=1)
    refused = edge(truth, 0, 3, error=shifted(1.0), accepted=False)
    found = solve_graph(range(4), [*right, refused], SETTINGS)
    assert len(found.kept) == 3
    assert found.contradicted == ()
    assert solve_graph([0, 3], [refused], SETTINGS).poses.keys() == {0}


def test_the_largest_connected_set_is_solved_and_the_others_are_left_out() -> None:
    truth = line(7)
    edges = [*along({n: truth[n] for n in (2, 3, 4, 5)}), edge(truth, 0, 1)]
    found = solve_graph(range(7), edges, SETTINGS)
    assert set(found.poses) == {2, 3, 4, 5}
    assert pairs_of(found.kept) == {(2, 3), (3, 4), (4, 5), (2, 4), (3, 5)}


@pytest.mark.parametrize("by", [0.5, 2.4, 12.0])
def test_a_wrong_loop_edge_is_thrown_out_and_leaves_no_trace_in_the_poses(by: float) -> None:
    truth = ring(12)
    right = around(truth)
    wrong = edge(truth, 1, 7, error=shifted(by, yaw=0.1))
    found = solve_graph(range(12), [*right, wrong], SETTINGS)
    assert pairs_of(found.contradicted) == {(1, 7)}
    assert len(found.kept) == 24
    without = solve_graph(range(12), right, SETTINGS)
    assert worst(found, truth) < 0.015
    assert max(
        difference(
            inverse(found.poses[0]) @ found.poses[n], inverse(without.poses[0]) @ without.poses[n]
        )[0]
        for n in truth
    ) < 0.001  # fmt: skip


def test_a_wrong_edge_in_the_place_of_a_short_cut_is_thrown_out_too() -> None:
    """It shares triangles with right ones, which then do not close."""
    truth = ring(12)
    edges = [each for each in around(truth) if (each.target, each.source) != (4, 6)]
    found = solve_graph(range(12), [*edges, edge(truth, 4, 6, error=shifted(0.4))], SETTINGS)
    assert pairs_of(found.contradicted) == {(4, 6)}
    assert worst(found, truth) < 0.015


def test_wrong_edges_that_agree_among_themselves_are_outvoted() -> None:
    """Five, whose triangles close, have three scans three metres on, as a repeating corridor would; twelve do not."""
    truth = ring(12)
    slid = truth | {number: shifted(3.0) @ truth[number] for number in (6, 7, 8)}
    wrong = [edge(slid, a, b) for a, b in ((0, 6), (1, 7), (2, 8), (0, 7), (1, 6))]
    found = solve_graph(range(12), [*around(truth, reach=3), *wrong], SETTINGS)
    assert pairs_of(found.contradicted) == pairs_of(wrong)
    assert set(found.poses) == set(truth)
    assert worst(found, truth) < 0.015


def test_few_right_edges_win_over_more_wrong_ones_of_lower_confidence() -> None:
    """Two halves, tied by three sure registrations and, a door further on, by four that free space speaks against."""
    truth = line(10)
    halves = [*along({n: truth[n] for n in range(5)}), *along({n: truth[n] for n in range(5, 10)})]
    right = [edge(truth, 4, 5), edge(truth, 3, 5), edge(truth, 4, 6)]
    slid = truth | {number: shifted(2.0) @ truth[number] for number in range(5, 10)}
    wrong = [edge(slid, a, b, **DOUBTFUL) for a, b in ((2, 5), (2, 6), (3, 6), (3, 7))]
    found = solve_graph(range(10), [*halves, *right, *wrong], SETTINGS)
    assert pairs_of(found.contradicted) == pairs_of(wrong)
    assert worst(found, truth) < 0.03


def test_two_sure_edges_win_over_eight_doubtful_ones_that_agree_and_outweigh_them() -> None:
    """Each of the eight is believed by a third; what the surest tree rules out is not heard at first."""
    truth = line(10)
    halves = [*along({n: truth[n] for n in range(5)}), *along({n: truth[n] for n in range(5, 10)})]
    right = [edge(truth, 4, 5), edge(truth, 3, 5)]
    slid = truth | {number: shifted(2.0) @ truth[number] for number in range(5, 10)}
    across = ((2, 6), (1, 6), (4, 8), (3, 7), (2, 7), (1, 5), (4, 7), (3, 8))
    wrong = [edge(slid, a, b, agreement=0.89) for a, b in across]
    assert sum(each.confidence for each in wrong) > sum(each.confidence for each in right)
    found = solve_graph(range(10), [*halves, *right, *wrong], SETTINGS)
    assert pairs_of(found.contradicted) == pairs_of(wrong)
    assert worst(found, truth) < 0.03


def test_of_two_registrations_of_one_scan_that_contradict_each_other_the_surer_one_stays() -> None:
    """Scan 12 hangs on one scan at either side of the ring."""
    truth = ring(12) | {12: shifted(8.0, 0, 0.35)}
    right = edge(truth, 0, 12)
    wrong = edge(truth, 6, 12, error=shifted(2.0), **DOUBTFUL)
    found = solve_graph(range(13), [*around(ring(12)), right, wrong], SETTINGS)
    assert pairs_of(found.contradicted) == {(6, 12)}
    assert 12 in found.poses
    assert worst(found, truth) < 0.02


def test_paths_lead_from_the_reference_over_registrations_that_were_kept() -> None:
    truth = ring(12)
    wrong = edge(truth, 1, 7, error=shifted(1.0))
    found = solve_graph(range(12), [*around(truth), wrong], SETTINGS)
    kept = pairs_of(found.kept)
    assert set(found.paths) == set(truth)
    for number, path in found.paths.items():
        assert (path[0], path[-1]) == (found.reference, number)
        assert all((min(hop), max(hop)) in kept for hop in itertools.pairwise(path))


def test_the_order_in_which_registrations_come_does_not_matter() -> None:
    truth = ring(12)
    edges = [*around(truth), edge(truth, 1, 7, error=shifted(1.0))]
    shuffled = [edges[at] for at in np.random.default_rng(0).permutation(len(edges))]
    found, again = (solve_graph(range(12), each, SETTINGS) for each in (edges, shuffled))
    assert apart(found, again) < 1e-6
    assert pairs_of(found.kept) == pairs_of(again.kept)


def test_a_single_scan_is_its_own_frame() -> None:
    found = solve_graph([4], [], SETTINGS)
    assert found.reference == 4
    assert found.poses[4].tolist() == np.eye(4).tolist()
    assert found.paths == {4: (4,)}
