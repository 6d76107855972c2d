"""The three operations of Section 3.5.1."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worker.training.conftest import HALF
from worker.training.anomalies import (
    Changed,
    ChangeSize,
    add_object,
    move_object,
    nuisance_sigma,
    remove_object,
    shown,
)

CHANGE = ChangeSize(magnitude=0.3, density=0.075)


@pytest.fixture
def tile() -> np.ndarray:
    """400 points well inside the tile, so that a shift of 0.3 m meets no edge."""
    return np.random.default_rng(0).uniform(-0.1, 0.1, (400, 3)).astype(np.float32)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_adding_keeps_every_point_and_adds_the_density(tile):
    changed = add_object(tile, CHANGE, HALF, rng())
    assert len(changed.appeared) == 30  # 7.5% of 400
    assert len(changed.vanished) == 0
    assert np.array_equal(changed.points, np.concatenate([tile, changed.appeared]))


def test_removing_takes_the_neighbours_of_one_point(tile):
    changed = remove_object(tile, CHANGE, HALF, rng())
    gone = changed.vanished
    assert (len(gone), len(changed.points), len(changed.appeared)) == (30, 370, 0)
    spread = np.linalg.norm(gone - gone[0], axis=1).max()  # the nearest to the centre, itself, comes first
    assert (np.linalg.norm(changed.points - gone[0], axis=1) >= spread).all()


def test_removing_leaves_64_points_and_nothing_below_that():
    few = rng().uniform(-0.1, 0.1, (70, 3)).astype(np.float32)
    half_gone = ChangeSize(magnitude=0.3, density=0.5)
    assert len(remove_object(few, half_gone, HALF, rng()).points) == 64
    assert len(remove_object(few[:50], half_gone, HALF, rng()).points) == 50


def test_moving_shifts_the_cluster_as_one(tile):
    changed = move_object(tile, CHANGE, HALF, rng())
    shifts = changed.appeared - changed.vanished
    assert len(shifts) == 30
    assert shifts == pytest.approx(np.broadcast_to(shifts[0], shifts.shape), abs=1e-6)
    assert (changed.points != tile).any(axis=1).sum() == 30


def test_a_move_has_the_magnitude_less_what_its_vertical_part_loses(tile):
    for seed in range(20):
        changed = move_object(tile, CHANGE, HALF, rng(seed))
        shift = (changed.appeared - changed.vanished)[0]
        assert np.linalg.norm(shift / [1, 1, 0.3]) == pytest.approx(0.3, abs=1e-5)


def test_an_addition_has_the_magnitude_less_what_its_vertical_part_loses(tile):
    """The jitter has a sigma of 16 mm and averages out over the 30 points."""
    for seed in range(20):
        copied = remove_object(tile, CHANGE, HALF, rng(seed)).vanished  # the same cluster of the same stream
        shift = (add_object(tile, CHANGE, HALF, rng(seed)).appeared - copied).mean(axis=0)
        assert np.linalg.norm(shift / [1, 1, 0.25]) == pytest.approx(0.3, abs=0.04)


@pytest.mark.parametrize("operation", [add_object, move_object])
def test_nothing_leaves_the_tile(operation):
    edge = (rng().uniform(-1, 1, (400, 3)) * HALF).astype(np.float32)
    for seed in range(20):
        changed = operation(edge, ChangeSize(magnitude=0.5, density=0.3), HALF, rng(seed))
        assert (np.abs(changed.points) <= HALF).all()


def test_the_jitter_grows_with_the_magnitude():
    assert nuisance_sigma(0.5) == pytest.approx(0.026)


def test_a_doubled_piece_of_floor_shows_nothing_and_a_lifted_one_shows_all():
    floor = np.stack(np.meshgrid(np.arange(-0.7, 0.7, 0.05), np.arange(-0.7, 0.7, 0.05), [-0.4]), -1)
    floor = floor.reshape(-1, 3).astype(np.float32)
    for height, expected in ((0.0, 0), (0.2, 25)):
        appeared = floor[:25] + np.array([0.02, 0.02, height], dtype=np.float32)
        after = Changed(points=np.concatenate([floor, appeared]), appeared=appeared, vanished=floor[:0])
        assert shown(floor, after, 0.075) == expected


def test_a_removed_cluster_shows_but_for_its_rim(tile):
    changed = remove_object(tile, ChangeSize(magnitude=0.3, density=0.3), HALF, rng())
    distance = np.linalg.norm(changed.vanished[:, None] - changed.points, axis=2).min(axis=1)
    assert 0 < shown(tile, changed, 0.03) == (distance > 0.03).sum() < len(changed.vanished)
