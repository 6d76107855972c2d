"""How far a survey lies off a map, for poses whose errors are put in."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.revisit.misalignment import points_in, residual_misalignments, stated_sigmas
from worker.benchmarks.trajectory import PlacedScan
from worker.cloud.tiling import TileGrid
from worker.pipeline.registration.results import RegistrationResult, Uncertainty
from worker.simulation.scenes import rigid

GRID = TileGrid(origin=np.zeros(3), size=np.ones(3), shape=(4, 1, 1))
INDICES = np.array([[0, 0, 0], [3, 0, 0]], dtype=np.int32)  # middles at x = 0.5 and 3.5


def placed(true, error, *, points=((0.5, 0.5, 0.5), (3.5, 0.5, 0.5)), sigma=None) -> PlacedScan:
    """A scan whose points, in the map frame and at the pose that was found, are these."""
    found = error @ true
    there = np.array(points, np.float64)
    return PlacedScan(
        points=((there - found[:3, 3]) @ found[:3, :3]).astype(np.float32),
        placement=RegistrationResult(
            map_from_scan=found,
            sensor_origin=None,
            fitness=1.0,
            inlier_rmse=0.0,
            overlap=1.0,
            two_way_inlier_ratio=1.0,
            from_global_search=False,
            uncertainty=sigma,
        ),
        true=true,
    )


EXACT = placed(rigid(1.0, 2.0, 0.3, yaw=30), np.eye(4))


def test_exact_poses_have_no_misalignment():
    assert residual_misalignments([EXACT], [EXACT], GRID, INDICES) == pytest.approx([0, 0], abs=1e-9)


def test_a_survey_shifted_by_three_centimetres_is_off_by_that_everywhere():
    survey = placed(rigid(yaw=70), rigid(0.0, 0.03))
    assert residual_misalignments([EXACT], [survey], GRID, INDICES) == pytest.approx([0.03, 0.03])


def test_a_turn_grows_with_the_distance_from_where_it_turns():
    survey = placed(np.eye(4), rigid(yaw=1.0))
    off = residual_misalignments([EXACT], [survey], GRID, INDICES)
    middle = np.hypot(0.5, 0.5), np.hypot(3.5, 0.5)
    assert off == pytest.approx(np.radians(1.0) * np.array(middle), rel=1e-3)


def test_map_and_survey_that_are_wrong_alike_do_not_disagree():
    both = placed(np.eye(4), rigid(0.05))
    assert residual_misalignments([both], [both], GRID, INDICES) == pytest.approx([0, 0], abs=1e-9)


def test_scans_weigh_by_their_points_in_the_tile():
    three = placed(np.eye(4), rigid(0.04), points=[(0.5, 0.5, 0.5)] * 3)
    one = placed(np.eye(4), np.eye(4))
    off = residual_misalignments([EXACT], [three, one], GRID, INDICES)
    assert off == pytest.approx([0.03, 0.0], abs=1e-9)


def test_a_tile_that_nobody_saw_has_no_misalignment_and_no_sigma():
    near = placed(
        np.eye(4), np.eye(4), points=[(0.5, 0.5, 0.5)], sigma=Uncertainty(translation=0.01, rotation=0)
    )
    assert np.isnan(residual_misalignments([EXACT], [near], GRID, INDICES)).tolist() == [False, True]
    assert np.isnan(stated_sigmas([near], GRID, INDICES)).tolist() == [False, True]
    assert np.isnan(residual_misalignments([EXACT], [], GRID, INDICES)).all()


def test_the_stated_sigma_adds_the_lever_of_the_turn():
    scan = placed(rigid(0.5, 0.5, 0.5), np.eye(4), sigma=Uncertainty(translation=0.03, rotation=0.04 / 3))
    assert stated_sigmas([scan], GRID, INDICES) == pytest.approx([0.03, 0.05])


def test_a_scan_without_a_sigma_states_nothing():
    assert np.isnan(stated_sigmas([EXACT], GRID, INDICES)).all()


def test_points_are_counted_where_the_pose_that_was_found_puts_them():
    scan = placed(
        np.eye(4), np.eye(4), points=[(0.1, 0.1, 0.1), (0.9, 0.9, 0.9), (3.2, 0.5, 0.5), (-1, 0, 0)]
    )
    assert points_in(scan, GRID, INDICES).tolist() == [2, 1]
