"""A kernel's points push each other apart until they rest."""

from __future__ import annotations

import numpy as np
import pytest

from worker.detectors.kpconv.kernel_points import forces, kernel_points


def test_fifteen_points_one_in_the_middle_the_others_at_one_and_a_half_sigma():
    points = kernel_points()
    assert points.shape == (15, 3)
    assert points[0].tolist() == [0, 0, 0]
    assert np.linalg.norm(points[1:], axis=1).mean() == pytest.approx(1.5)


def test_they_are_spread_evenly():
    points = kernel_points()
    apart = np.linalg.norm(points[:, None] - points, axis=2) + 9 * np.eye(15)
    nearest = apart.min(axis=1)
    assert nearest[1:].min() > 1.2
    assert nearest[1:].max() < 1.25 * nearest[1:].min()


def test_two_points_push_each_other_and_are_pulled_to_the_middle_by_hand():
    at = np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    # 1 / 2^2 apart, 2 * 1 inwards
    assert forces(at) == pytest.approx(np.array([[0.25 - 2, 0, 0], [2 - 0.25, 0, 0]]))


def test_at_the_end_nothing_moves_any_more():
    points = kernel_points()
    scaled = points / np.linalg.norm(points[1:], axis=1).mean()
    sizes = np.geomspace(0.5, 3, 2000)
    rest = min(np.abs(forces(scaled * size)[1:]).max() for size in sizes)
    assert rest < 0.02
