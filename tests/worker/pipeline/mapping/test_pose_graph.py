"""Graphs of known poses with errors of 5 mm and 0.06 degrees in each registration."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
import pytest

from tests.support.graphs import along, around, edge, line, ring, shifted
from worker.cloud.poses import difference, exponential, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.mapping.pose_graph import (
    Solution,
    chain,
    components,
    map_from_reference,
    most_reliable_tree,
    reference_of,
    reliability,
    solve_graph,
    triangle_counts,
)
from worker.pipeline.mapping.settings import MappingSettings
from worker.pipeline.registration.scan_to_scan import PairResult

SETTINGS = MappingSettings()
MOTION = exponential(np.array([0.02, -0.01, 1.9, 4.0, -7.0, 0.3]))
TRUTH = line(8)
doubtful = partial(edge, two_way_inlier_ratio=0.84, free_space_violation=0.003)


def test_the_largest_component_comes_first_and_of_equal_ones_that_with_the_lowest_index() -> None:
    edges = [edge(TRUTH, 4, 6), edge(TRUTH, 0, 7), edge(TRUTH, 2, 3), edge(TRUTH, 3, 5)]
    assert components(range(8), edges) == [(2, 3, 5), (0, 7), (4, 6), (1,)]


def test_scans_without_any_registration_are_components_of_their_own() -> None:
    assert components([5, 2], []) == [(2,), (5,)]


def test_the_reference_is_the_scan_with_the_most_registrations() -> None:
    edges = [edge(TRUTH, 0, 2), edge(TRUTH, 1, 2), edge(TRUTH, 2, 3, fitness=0.1), edge(TRUTH, 0, 1)]
    assert reference_of(range(4), edges) == 2


def test_of_scans_with_as_many_registrations_the_reference_is_that_of_highest_mean_fitness() -> None:
    edges = [edge(TRUTH, 0, 1, fitness=0.6), edge(TRUTH, 1, 2, fitness=0.9), edge(TRUTH, 0, 2, fitness=0.7)]
    assert reference_of(range(3), edges) == 2  # 0.8 beside 0.65 and 0.75


def test_of_scans_that_are_equal_in_all_the_first_is_the_reference() -> None:
    assert reference_of([3, 1, 2], []) == 1


def test_a_chain_gives_the_known_poses_and_names_the_scans_on_the_way() -> None:
    found = chain(range(8), along(TRUTH, reach=1, noise=False), SETTINGS)
    assert found.reference == 1
    assert found.paths[6] == (1, 2, 3, 4, 5, 6)
    assert found.paths[0] == (1, 0)
    assert found.paths[1] == (1,)
    for number, pose in found.poses.items():
        assert pose == pytest.approx(inverse(TRUTH[1]) @ TRUTH[number], abs=1e-9)


def test_a_path_takes_fewer_registrations_where_all_can_be_relied_on() -> None:
    found = chain(range(6), around(ring(6), noise=False), SETTINGS)
    assert found.reference == 0
    assert {number: len(path) - 1 for number, path in found.paths.items()} == {
        0: 0, 1: 1, 2: 1, 3: 2, 4: 1, 5: 1,
    }  # fmt: skip


def test_a_path_goes_round_a_doubtful_registration() -> None:
    sure = [edge(TRUTH, a, b) for a, b in ((0, 1), (1, 2), (2, 3), (0, 4), (0, 5), (0, 6))]
    found = chain(range(7), [*sure, edge(TRUTH, 0, 3)], SETTINGS)
    assert found.paths[3] == (0, 3)
    found = chain(range(7), [*sure, doubtful(TRUTH, 0, 3)], SETTINGS)
    assert found.paths[3] == (0, 1, 2, 3)


def test_where_there_is_but_a_doubtful_registration_a_path_takes_one_not_two() -> None:
    edges = [
        *(edge(TRUTH, 0, number) for number in (1, 2, 5)),
        *(doubtful(TRUTH, a, b) for a, b in ((1, 3), (3, 4), (2, 4))),
    ]
    found = chain(range(6), edges, SETTINGS)
    assert found.paths[4] == (0, 2, 4)
    assert found.paths[3] == (0, 1, 3)


def test_the_tree_of_what_can_be_relied_on_takes_a_long_way_round() -> None:
    """The reference of this ring is scan 0; the edge back to it is a little less sure than all the others."""
    truth = ring(6)
    edges = [edge(truth, number, number + 1) for number in range(5)]
    edges += [edge(truth, 0, 5, two_way_inlier_ratio=0.93), edge({**truth, 6: truth[0]}, 0, 6)]
    assert most_reliable_tree(range(7), edges, SETTINGS).paths[5] == (0, 1, 2, 3, 4, 5)
    assert chain(range(7), edges, SETTINGS).paths[5] == (0, 5)


def test_a_triangle_that_closes_counts_for_its_three_registrations_and_one_that_does_not_against_them() -> (
    None
):
    edges = [edge(TRUTH, 0, 1), edge(TRUTH, 1, 2), edge(TRUTH, 0, 2), edge(TRUTH, 2, 3)]
    closing, open_ = triangle_counts(edges, SETTINGS)
    assert (closing.tolist(), open_.tolist()) == ([1, 1, 1, 0], [0, 0, 0, 0])
    astray = [*edges[:2], edge(TRUTH, 0, 2, error=shifted(0.2)), edges[3]]
    closing, open_ = triangle_counts(astray, SETTINGS)
    assert (closing.tolist(), open_.tolist()) == ([0, 0, 0, 0], [1, 1, 1, 0])


@pytest.mark.parametrize(
    ("error", "closes"),
    [
        (shifted(0.09), True),
        (shifted(0.11), False),
        (shifted(yaw=np.radians(1.4)), True),
        (shifted(yaw=np.radians(1.6)), False),
    ],
)
def test_a_triangle_closes_within_ten_centimetres_and_a_degree_and_a_half(
    error: np.ndarray, closes: bool
) -> None:
    """The frame of the error is that of a scan in the triangle's own corner, so that the turn moves nothing else."""
    truth = {number: shifted(yaw=0.3 * number) for number in range(3)}
    edges = [edge(truth, 0, 1), edge(truth, 1, 2), edge(truth, 0, 2, error=error)]
    assert triangle_counts(edges, SETTINGS)[0].tolist() == [float(closes)] * 3


def test_a_triangle_closes_whichever_scan_is_the_target() -> None:
    """A cycle 0 <- 1 <- 2 <- 0: the last registration is told the other way round."""
    edges = [edge(TRUTH, 0, 1), edge(TRUTH, 1, 2), edge(TRUTH, 2, 0)]
    assert triangle_counts(edges, SETTINGS)[0].tolist() == [1, 1, 1]


def test_reliability_grows_with_triangles_that_close_and_falls_with_those_that_do_not() -> None:
    alone = reliability([edge(TRUTH, 0, 1)], SETTINGS)[0]
    triangle = [edge(TRUTH, 0, 1), edge(TRUTH, 1, 2), edge(TRUTH, 0, 2)]
    consistent_with_prior = reliability(triangle, SETTINGS)[0]
    contradicted = reliability([*triangle[:2], edge(TRUTH, 0, 2, error=shifted(1.0))], SETTINGS)[0]
    assert contradicted < alone < consistent_with_prior


questionable = partial(edge, two_way_inlier_ratio=0.84, free_space_violation=0.002)


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
    assert found.rejected == ()


def test_a_registration_that_was_not_accepted_is_not_heard() -> None:
    truth = line(4)
    right = along(truth, reach=1)
    refused = edge(truth, 0, 3, error=shifted(1.0), accepted=False)
    found = solve_graph(range(4), [*right, refused], SETTINGS)
    assert len(found.kept) == 3
    assert found.rejected == ()
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
    assert pairs_of(found.rejected) == {(1, 7)}
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
    assert pairs_of(found.rejected) == {(4, 6)}
    assert worst(found, truth) < 0.015


def test_wrong_edges_that_agree_among_themselves_are_outvoted() -> None:
    """Five, whose triangles close, have three scans three metres on, as a repeating corridor would; twelve do not."""
    truth = ring(12)
    slid = truth | {number: shifted(3.0) @ truth[number] for number in (6, 7, 8)}
    wrong = [edge(slid, a, b) for a, b in ((0, 6), (1, 7), (2, 8), (0, 7), (1, 6))]
    found = solve_graph(range(12), [*around(truth, reach=3), *wrong], SETTINGS)
    assert pairs_of(found.rejected) == pairs_of(wrong)
    assert set(found.poses) == set(truth)
    assert worst(found, truth) < 0.015


def test_few_right_edges_win_over_more_wrong_ones_of_lower_confidence() -> None:
    """Two halves, tied by three sure registrations and, a door further on, by four that free space speaks against."""
    truth = line(10)
    halves = [*along({n: truth[n] for n in range(5)}), *along({n: truth[n] for n in range(5, 10)})]
    right = [edge(truth, 4, 5), edge(truth, 3, 5), edge(truth, 4, 6)]
    slid = truth | {number: shifted(2.0) @ truth[number] for number in range(5, 10)}
    wrong = [questionable(slid, a, b) for a, b in ((2, 5), (2, 6), (3, 6), (3, 7))]
    found = solve_graph(range(10), [*halves, *right, *wrong], SETTINGS)
    assert pairs_of(found.rejected) == pairs_of(wrong)
    assert worst(found, truth) < 0.03


def test_two_sure_edges_win_over_eight_doubtful_ones_that_agree_and_outweigh_them() -> None:
    """Each of the eight is believed by a third; what the surest tree rules out is not heard at first."""
    truth = line(10)
    halves = [*along({n: truth[n] for n in range(5)}), *along({n: truth[n] for n in range(5, 10)})]
    right = [edge(truth, 4, 5), edge(truth, 3, 5)]
    slid = truth | {number: shifted(2.0) @ truth[number] for number in range(5, 10)}
    across = ((2, 6), (1, 6), (4, 8), (3, 7), (2, 7), (1, 5), (4, 7), (3, 8))
    wrong = [edge(slid, a, b, two_way_inlier_ratio=0.89) for a, b in across]
    assert sum(each.confidence for each in wrong) > sum(each.confidence for each in right)
    found = solve_graph(range(10), [*halves, *right, *wrong], SETTINGS)
    assert pairs_of(found.rejected) == pairs_of(wrong)
    assert worst(found, truth) < 0.03


def test_of_two_registrations_of_one_scan_that_contradict_each_other_the_surer_one_stays() -> None:
    """Scan 12 hangs on one scan at either side of the ring."""
    truth = ring(12) | {12: shifted(8.0, 0, 0.35)}
    right = edge(truth, 0, 12)
    wrong = questionable(truth, 6, 12, error=shifted(2.0))
    found = solve_graph(range(13), [*around(ring(12)), right, wrong], SETTINGS)
    assert pairs_of(found.rejected) == {(6, 12)}
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


# the frame of a map


def test_without_a_prior_the_reference_scan_is_the_frame() -> None:
    assert map_from_reference(ring(4), {}, 2).tolist() == np.eye(4).tolist()


def test_with_two_priors_the_references_own_is_met_exactly() -> None:
    truth = ring(4)
    poses = {number: inverse(truth[1]) @ pose for number, pose in truth.items()}
    astray = {0: shifted(5.0) @ truth[0], 1: truth[1]}
    assert map_from_reference(poses, astray, 1) == pytest.approx(truth[1])


def test_with_two_priors_and_none_of_the_reference_the_first_of_the_others_is_met() -> None:
    truth = ring(4)
    poses = {number: inverse(truth[1]) @ pose for number, pose in truth.items()}
    frame = map_from_reference(poses, {2: truth[2], 3: shifted(5.0) @ truth[3]}, 1)
    assert frame @ poses[2] == pytest.approx(truth[2])
    assert frame == pytest.approx(truth[1])


def test_a_prior_of_a_scan_that_has_no_pose_is_not_asked() -> None:
    frame = map_from_reference({0: np.eye(4)}, {0: MOTION, 8: np.eye(4), 9: np.eye(4)}, 0)
    assert frame == pytest.approx(MOTION)


def test_one_bad_heading_is_outweighed_though_it_is_the_references() -> None:
    truth = ring(8)
    poses = {number: inverse(truth[0]) @ pose for number, pose in truth.items()}
    priors = truth | {0: truth[0] @ shifted(yaw=np.radians(20))}
    metres, radians = difference(map_from_reference(poses, priors, 0), truth[0])
    assert np.degrees(radians) < 1.0
    assert metres < 0.1
    alone = map_from_reference(poses, {0: priors[0]}, 0)
    assert np.degrees(difference(alone, truth[0])[1]) == pytest.approx(20.0)
