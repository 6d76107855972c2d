"""Reliability and expected calibration error of probabilities that are put in."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worker.benchmarks.revisit.conftest import seen_of, truth_of
from worker.benchmarks.revisit.calibration import Reliability, voxel_reliability
from worker.cloud.voxel_keys import packed, unpacked
from worker.detectors.detector import VoxelScores
from worker.simulation.hits import Visit


def test_the_error_is_the_mean_gap_between_probability_and_share():
    told = Reliability.of(np.array([0.05, 0.05, 0.72, 0.74, 0.74, 1.0]), np.array([0, 0, 1, 1, 0, 1], bool))
    assert told.counts.tolist() == [2, 0, 0, 0, 0, 0, 0, 3, 0, 1]
    assert told.changed.tolist() == [0, 0, 0, 0, 0, 0, 0, 2, 0, 1]
    assert told.expected_error() == pytest.approx((0.1 + 0.2 + 0.0) / 6)
    assert told.expected_error(0.1) == pytest.approx(0.2 / 4)


def test_what_is_always_right_has_no_error_and_nothing_has_none():
    assert Reliability.of(np.array([0.0, 1.0]), np.array([False, True])).expected_error() == 0
    assert Reliability.of(np.empty(0), np.empty(0, bool)).expected_error() is None
    assert Reliability.pooled([None]) is None


def test_pooled_bins_add_up():
    one = Reliability.of(np.array([0.3]), np.array([True]))
    both = Reliability.pooled([one, None, one])
    assert both is not None
    assert (both.counts.sum(), both.changed.sum()) == (2, 2)


def test_voxels_near_a_true_change_but_not_beside_it_are_not_asked_about():
    plate = packed(np.array([[20, y, z] for y in range(10) for z in range(10)]))
    beside, near, far = (packed(unpacked(plate) + np.array([off, 0, 0])) for off in (1, 2, 6))
    hit = np.unique(np.concatenate([plate, beside, near, far]))
    voxels = VoxelScores(
        keys=hit,
        appeared=np.full(len(hit), 0.8, np.float32),
        disappeared=np.zeros(len(hit), np.float32),
        judged=np.ones(len(hit), bool),
        moving=np.zeros(len(hit), bool),
        seen_through=np.ones(len(hit), np.int16),
    )
    truth = truth_of([(plate, "add", Visit.SECOND, True)])
    told = voxel_reliability(voxels, truth, seen_of(np.empty(0, np.int64)), seen_of(hit))
    assert told is not None
    assert told.counts.sum() == 300  # the plate, what is beside it, and what is far
    assert told.changed.sum() == 200
