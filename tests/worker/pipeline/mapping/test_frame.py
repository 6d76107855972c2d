from __future__ import annotations

import numpy as np
import pytest

from tests.support.graphs import ring, shifted
from worker.cloud.poses import difference, exponential, inverse
from worker.pipeline.mapping.frame import fitted, map_from_reference

MOTION = exponential(np.array([0.02, -0.01, 1.9, 4.0, -7.0, 0.3]))


def test_fitted_undoes_a_known_motion() -> None:
    poses = list(ring(5).values())
    found = fitted(poses, [MOTION @ pose for pose in poses])
    assert found == pytest.approx(MOTION, abs=1e-9)


def test_fitted_stays_a_rotation_where_the_scans_stand_on_one_line() -> None:
    """Places alone leave the turn about the line free; headings hold it."""
    poses = [shifted(2.0 * number) for number in range(4)]
    found = fitted(poses, [MOTION @ pose for pose in poses])
    assert found == pytest.approx(MOTION, abs=1e-9)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


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
