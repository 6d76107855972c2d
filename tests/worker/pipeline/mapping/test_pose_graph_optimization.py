"""Poses are map_from_scan; twists (rotation, translation) act in the map's frame."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.graphs import INFORMATION, along, around, edge, line, ring, shifted
from worker.cloud.poses import adjoint, difference, exponential, inverse
from worker.pipeline.mapping.pose_graph_optimization import (
    Factor,
    covariances,
    optimize,
    pose_graph_factors,
    residual,
    retract,
    solve,
)
from worker.pipeline.mapping.settings import MappingSettings

SETTINGS = MappingSettings()
SMALL = exponential(np.array([0.002, -0.003, 0.004, 0.01, -0.02, 0.015]))


def test_a_twist_in_one_frame_is_the_same_motion_in_another() -> None:
    """Against central differences of pose @ exp(d) @ pose^-1."""
    pose = exponential(np.array([0.4, -0.7, 1.1, 3.0, -2.0, 0.5]))
    step = 1e-6
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = step
        there, back = (pose @ exponential(sign * twist) @ inverse(pose) for sign in (1, -1))
        spin = (there - back)[:3, :3] / (2 * step)
        expected = np.r_[spin[2, 1], spin[0, 2], spin[1, 0], (there - back)[:3, 3] / (2 * step)]
        assert adjoint(pose)[:, axis] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("scan", [1, 3, 7])
def test_solve_undoes_a_known_small_motion_of_one_scan(scan: int) -> None:
    truth = ring(8)
    edges = around(truth, noise=False)
    current = truth | {scan: SMALL @ truth[scan]}
    steps = solve(list(truth), pose_graph_factors(current, edges, np.ones(len(edges))), fixed=0)
    assert set(steps) == set(truth) - {0}
    for number, pose in retract(current, steps).items():
        metres, radians = difference(pose, truth[number])
        assert metres < 2e-4  # what is left is of second order in the motion
        assert radians < 2e-5


def test_the_fixed_scan_stays_and_the_others_come_to_it() -> None:
    truth = line(3)
    edges = along(truth, noise=False)
    current = truth | {1: SMALL @ truth[1]}
    steps = solve([0, 1, 2], pose_graph_factors(current, edges, np.ones(3)), fixed=1)
    after = retract(current, steps)
    assert after[1].tolist() == current[1].tolist()
    wanted = current[1] @ inverse(truth[1]) @ truth[2]
    assert difference(after[2], wanted)[0] < 2e-4


def test_registrations_that_disagree_are_averaged_by_their_weights() -> None:
    truth = {0: np.eye(4), 1: shifted(2.0)}
    edges = [edge(truth, 0, 1), edge(truth, 0, 1, error=shifted(0.04))]
    steps = solve([0, 1], pose_graph_factors(truth, edges, np.array([1.0, 3.0])), fixed=0)
    assert retract(truth, steps)[1][0, 3] == pytest.approx(2.03, abs=1e-5)


def test_each_registration_is_heard_in_the_directions_that_it_knows() -> None:
    """One knows x of its target's frame, the other y; the target is turned, so that both differ from the map's."""
    truth = {0: shifted(5.0, 3.0, yaw=1.0), 1: shifted(6.0, 5.0, yaw=2.0)}
    knows_x, knows_y = np.diag([4e4] * 3 + [1e4, 1.0, 1e4]), np.diag([4e4] * 3 + [1.0, 1e4, 1e4])
    edges = [
        edge(truth, 0, 1, error=shifted(0.02, 0.3), information=knows_x),
        edge(truth, 0, 1, error=shifted(0.3, 0.05), information=knows_y),
    ]
    steps = solve([0, 1], pose_graph_factors(truth, edges, np.ones(2)), fixed=0)
    apart = inverse(truth[0]) @ retract(truth, steps)[1] @ inverse(inverse(truth[0]) @ truth[1])
    assert apart[:2, 3] == pytest.approx([0.02, 0.05], abs=1e-3)


def test_a_direction_that_no_registration_knows_is_left_where_it_is() -> None:
    truth = {0: np.eye(4), 1: shifted(2.0)}
    corridor = edge(truth, 0, 1, error=shifted(0, 0.02), information=np.diag([4e4] * 3 + [0.0, 1e4, 1e4]))
    current = truth | {1: shifted(2.5)}
    steps = solve([0, 1], pose_graph_factors(current, [corridor], np.ones(1)), fixed=0)
    x, y = retract(current, steps)[1][:2, 3]
    assert y == pytest.approx(0.02, abs=1e-4)
    assert 2.0 - 1e-3 < x < 2.5 + 1e-3


def chain_factors(*pairs: tuple[int, int]) -> list[Factor]:
    return [
        Factor(target=a, source=b, information=1000.0 * np.eye(6), gradient=np.zeros(6)) for a, b in pairs
    ]


def test_covariances_grow_along_a_chain_by_as_much_at_each_link() -> None:
    found = covariances(range(4), chain_factors((0, 1), (1, 2), (2, 3)), fixed=0, variance=4.0)
    assert set(found) == {1, 2, 3}
    for number, block in found.items():
        assert block == pytest.approx(number * 0.004 * np.eye(6))


def test_a_loop_that_closes_makes_every_scan_surer() -> None:
    """As resistors in parallel: one link and three make three quarters, two and two make one."""
    found = covariances(range(4), chain_factors((0, 1), (1, 2), (2, 3), (0, 3)), fixed=0, variance=1000.0)
    assert [found[number][3, 3] for number in (1, 2, 3)] == pytest.approx([0.75, 1.0, 0.75])


def test_covariances_are_those_against_the_fixed_scan() -> None:
    found = covariances(range(3), chain_factors((0, 1), (1, 2)), fixed=2, variance=1000.0)
    assert [found[number][0, 0] for number in (0, 1)] == pytest.approx([2.0, 1.0])


def test_scans_that_nothing_ties_to_the_fixed_one_stay_and_are_unsure() -> None:
    """Scan 3 hangs on scan 2 alone, scan 4 on nothing."""
    pull = np.array([0, 0, 0, 10.0, 0, 0])
    factors = [
        Factor(target=a, source=b, information=1000.0 * np.eye(6), gradient=pull) for a, b in ((0, 1), (2, 3))
    ]
    steps = solve(range(5), factors, fixed=0)
    assert steps[1] == pytest.approx(-pull / 1000)
    assert steps[2] + steps[3] == pytest.approx(np.zeros(6), abs=1e-9)
    assert steps[3] - steps[2] == pytest.approx(-pull / 1000, rel=0.01)
    assert steps[4].tolist() == [0] * 6
    found = covariances(range(5), factors, fixed=0, variance=1.0)
    assert found[1][3, 3] == pytest.approx(0.001)
    assert min(found[number][3, 3] for number in (2, 3, 4)) > 0.4


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (shifted(0.1), 1.0),
        (shifted(0.03, 0.04), 0.5),
        (shifted(yaw=0.026), 1.0),
        (np.eye(4), 0.0),
    ],
)
def test_a_residual_of_1_is_what_a_loop_may_be_off(error: np.ndarray, expected: float) -> None:
    truth = {0: shifted(4.0, 1.0, yaw=0.7), 1: shifted(4.0, 1.0, yaw=-0.4)}
    assert residual(truth, edge(truth, 0, 1, error=error), SETTINGS) == pytest.approx(expected, abs=1e-6)


def test_optimised_poses_are_nearer_to_the_truth_than_the_chain_that_they_came_from() -> None:
    truth = ring(12)
    edges = around(truth)
    at = {0: np.eye(4)}
    for number in range(1, 12):  # along single edges, so that errors add up
        link = next(each for each in edges if (each.target, each.source) == (number - 1, number))
        at[number] = at[number - 1] @ link.target_from_source
    poses, weights = optimize(at, edges, fixed=0, settings=SETTINGS)

    def worst(found: dict[int, np.ndarray]) -> float:
        return max(difference(found[n], inverse(truth[0]) @ truth[n])[0] for n in truth)

    assert worst(poses) < 0.5 * worst(at)
    assert worst(poses) < 0.02
    assert weights.min() > 0.8
    assert poses[0].tolist() == np.eye(4).tolist()


def test_a_registration_that_is_far_from_all_others_weighs_nothing_in_the_end() -> None:
    truth = ring(12)
    edges = [*around(truth), edge(truth, 0, 6, error=shifted(1.5))]
    poses, weights = optimize(truth, edges, fixed=0, settings=SETTINGS)
    assert weights[-1] < 0.01
    assert weights[:-1].min() > 0.8
    without, _ = optimize(truth, edges[:-1], fixed=0, settings=SETTINGS)
    assert max(difference(poses[n], without[n])[0] for n in truth) < 0.001


def test_a_registration_is_heard_by_its_confidence() -> None:
    """Two that are 6 cm apart: the scan stands where the surer one has it, not in the middle."""
    truth = {0: np.eye(4), 1: shifted(2.0)}
    sure = edge(truth, 0, 1)
    doubtful = edge(truth, 0, 1, error=shifted(0.06), two_way_inlier_ratio=0.84)
    poses, weights = optimize(truth, [sure, doubtful], fixed=0, settings=SETTINGS)
    assert weights[0] > 5 * weights[1]
    assert poses[1][0, 3] == pytest.approx(2.0, abs=0.012)


def test_a_single_scan_is_left_alone() -> None:
    poses, weights = optimize({3: SMALL}, [], fixed=3, settings=SETTINGS)
    assert poses[3].tolist() == SMALL.tolist()
    assert len(weights) == 0


def test_information_is_symmetric_and_never_singular() -> None:
    truth = ring(4)
    flat = edge(truth, 0, 1, information=np.diag([0.0, 0, 1e4, 1e4, 0, 0]))
    for term in pose_graph_factors(truth, [flat, edge(truth, 1, 2, information=INFORMATION)], np.ones(2)):
        assert term.information == pytest.approx(term.information.T)
        assert np.linalg.eigvalsh(term.information)[0] > 0
