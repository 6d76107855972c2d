from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.support.graphs import edge, line, shifted, small_errors
from tests.support.rooms import Room, as_scan
from worker.cloud.poses import difference, inverse
from worker.cloud.types import Matrix4
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.scan_to_scan import PairResult, coarse_pair, register_pair
from worker.pipeline.registration.settings import RegistrationSettings
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

SETTINGS = RegistrationSettings(max_iterations=15)
TRUTH = line(3)


@pytest.fixture(scope="module")
def pair(room: Room) -> tuple[PreparedScan, PreparedScan, Matrix4]:
    """Source, target, and the true target_from_source: 1.7 m and a quarter turn apart."""
    source, target = (prepare(as_scan(room.before[n].points[::2]), SETTINGS) for n in (1, 0))
    return source, target, inverse(room.before[0].world_from_sensor) @ room.before[1].world_from_sensor


@pytest.fixture(scope="module")
def foreign() -> PreparedScan:
    return prepare(as_scan(visit(random_room(11), 1, seed=5)[0].points[::2]), SETTINGS)


def off(found: PairResult, truth: Matrix4) -> tuple[float, float]:
    metres, radians = difference(found.target_from_source, truth)
    return metres, float(np.degrees(radians))


def assert_same(a: PairResult, b: PairResult) -> None:
    for name in PairResult.__slots__:
        one, other = getattr(a, name), getattr(b, name)
        if isinstance(one, np.ndarray):
            assert one.tolist() == other.tolist()
        else:
            assert one == other
            assert type(one) is type(other)


@pytest.mark.parametrize("rmse", [0.0251, float("inf")])
def test_a_result_comes_back_from_json_to_the_bit(rmse: float) -> None:
    result = replace(edge(TRUTH, 0, 2, error=small_errors(3), free_space_violation=0.004), inlier_rmse=rmse)
    text = json.dumps(result.document(), allow_nan=False)  # inf is no JSON
    assert_same(PairResult.of_document(json.loads(text)), result)


@pytest.mark.parametrize(
    "broken", [{}, {"inlier_rmse": 0.1}, edge(TRUTH, 0, 1).document() | {"target_from_source": [1, 2]}]
)
def test_anything_else_is_refused(broken: dict[str, object]) -> None:
    with pytest.raises((KeyError, ValueError, TypeError)):
        PairResult.of_document(broken)


def test_a_pair_is_found_from_a_drifted_prior(pair: tuple[PreparedScan, PreparedScan, Matrix4]) -> None:
    source, target, truth = pair
    prior = shifted(0.25, -0.15, yaw=np.radians(4)) @ truth
    found = register_pair((4, 7), source, target, prior=prior, settings=SETTINGS)
    metres, degrees = off(found, truth)
    assert metres < 0.015
    assert degrees < 0.2
    assert (found.target, found.source) == (4, 7)
    assert found.accepted
    assert found.consistent_with_prior
    assert found.free_space_violation < 0.002
    assert found.agreement > 0.9
    assert found.confidence > 0.5


def test_a_pose_far_from_the_prior_is_not_accepted(
    pair: tuple[PreparedScan, PreparedScan, Matrix4],
) -> None:
    source, target, truth = pair
    prior = shifted(1.6, 0, yaw=np.radians(60)) @ truth
    found = register_pair((0, 1), source, target, prior=prior, settings=SETTINGS)
    assert not found.accepted


def test_without_a_prior_the_best_of_the_starts_is_kept(
    pair: tuple[PreparedScan, PreparedScan, Matrix4],
) -> None:
    source, target, truth = pair
    starts = (shifted(2.5, 1.0, yaw=2.0) @ truth, shifted(0.2, 0.1, yaw=0.05) @ truth)
    found = register_pair((0, 1), source, target, prior=None, starts=starts, settings=SETTINGS)
    metres, degrees = off(found, truth)
    assert metres < 0.015
    assert degrees < 0.2
    assert found.accepted
    assert not found.consistent_with_prior


def test_scans_of_different_rooms_are_not_accepted(
    pair: tuple[PreparedScan, PreparedScan, Matrix4], foreign: PreparedScan
) -> None:
    starts = tuple(shifted(yaw=yaw) for yaw in (0.0, np.pi / 2))
    found = register_pair((0, 1), foreign, pair[1], prior=None, starts=starts, settings=SETTINGS)
    assert not found.accepted


def test_what_stands_in_seen_space_is_not_accepted_though_the_surfaces_agree(
    pair: tuple[PreparedScan, PreparedScan, Matrix4],
) -> None:
    source, target, truth = pair
    strict = SETTINGS.model_copy(
        update={"max_free_space_violation_near_prior": 0.0, "max_free_space_violation": 0.0}
    )
    assert target.image is not None
    farther = replace(target, image=replace(target.image, ranges=target.image.ranges * 1.5))
    found = register_pair((0, 1), source, farther, prior=truth, settings=strict)
    assert found.free_space_violation > 0.1
    assert not found.accepted
    assert register_pair((0, 1), source, farther, prior=truth, settings=SETTINGS).accepted is False


def test_information_is_that_of_the_pairs_of_points_in_the_targets_frame(
    pair: tuple[PreparedScan, PreparedScan, Matrix4],
) -> None:
    """Each pair adds its normal's outer product: the translations' part has as its trace the number of pairs."""
    source, target, truth = pair
    found = register_pair((0, 1), source, target, prior=truth, settings=SETTINGS)
    assert found.information == pytest.approx(found.information.T)
    pairs = np.trace(found.information[3:, 3:])
    assert 0.5 * len(source.surface.points) < pairs <= len(source.surface.points)
    assert np.linalg.eigvalsh(found.information)[0] > 0


@pytest.mark.parametrize(
    ("agreement", "free_space_violation", "expected"),
    [
        (0.95, 0.0, 1.0),
        (0.99, 0.0, 1.0),
        (0.95, 0.001, 0.5),  # half of it is gone at a point in a thousand
        (0.95, 0.003, 0.1),
        (0.875, 0.0, 0.25),
        (0.80, 0.0, 0.0025),
        (0.5, 0.0, 0.0025),
    ],
)
def test_confidence_falls_with_agreement_and_with_what_stands_in_free_space(
    agreement: float, free_space_violation: float, expected: float
) -> None:
    found = edge(TRUTH, 0, 1, agreement=agreement, free_space_violation=free_space_violation)
    assert found.confidence == pytest.approx(expected)


def test_a_rough_look_brings_a_pose_nearer_and_says_no_where_free_space_does(
    pair: tuple[PreparedScan, PreparedScan, Matrix4],
) -> None:
    source, target, truth = pair
    start = shifted(0.3, -0.2, yaw=0.07) @ truth
    found = coarse_pair(source, target, start, SETTINGS)
    assert difference(found.target_from_source, truth)[0] < 0.1 < difference(start, truth)[0]
    assert found.score > 0.5
    wrong = coarse_pair(source, target, shifted(2.5, 1.0, yaw=0.8) @ truth, SETTINGS)
    assert wrong.score == 0.0
