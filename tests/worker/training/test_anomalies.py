"""The three operations of Section 3.5.1."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worker.training.conftest import HALF
from worker.training.anomalies import Change, add_object, move_object, nuisance_sigma, remove_object

CHANGE = Change(magnitude=0.3, density=0.075)


@pytest.fixture
def tile() -> np.ndarray:
    """400 points well inside the tile, so that a shift of 0.3 m meets no edge."""
    return np.random.default_rng(0).uniform(-0.1, 0.1, (400, 3)).astype(np.float32)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_adding_keeps_every_point_and_adds_the_density(tile):
    changed = add_object(tile, CHANGE, HALF, rng())
    assert len(changed) == 430  # 400 and 7.5% of it
    assert np.array_equal(changed[:400], tile)


def test_removing_takes_the_neighbours_of_one_point(tile):
    changed = remove_object(tile, CHANGE, HALF, rng())
    assert len(changed) == 370
    kept = set(map(tuple, changed))
    gone = np.array([point for point in tile if tuple(point) not in kept])
    centre = gone[np.linalg.norm(gone[:, None] - gone, axis=2).max(axis=1).argmin()]
    spread = np.linalg.norm(gone - centre, axis=1).max()
    assert (np.linalg.norm(changed - centre, axis=1) < spread).sum() < 30  # a ball, not a scatter


def test_removing_leaves_64_points_and_nothing_below_that():
    few = rng().uniform(-0.1, 0.1, (70, 3)).astype(np.float32)
    half_gone = Change(magnitude=0.3, density=0.5)
    assert len(remove_object(few, half_gone, HALF, rng())) == 64
    assert len(remove_object(few[:50], half_gone, HALF, rng())) == 50


def test_moving_shifts_the_cluster_as_one(tile):
    changed = move_object(tile, CHANGE, HALF, rng())
    shifts = (changed - tile)[(changed != tile).any(axis=1)]
    assert len(shifts) == 30
    assert shifts == pytest.approx(np.broadcast_to(shifts[0], shifts.shape), abs=1e-6)


@pytest.mark.parametrize(("operation", "share"), [(move_object, 0.3), (add_object, 0.25)])
def test_a_shift_has_the_magnitude_less_what_its_vertical_part_loses(tile, operation, share):
    """Undoing the attenuation gives the full length again; jitter averages out over 30 points."""
    for seed in range(20):
        changed = operation(tile, CHANGE, HALF, rng(seed))
        before = move_object(tile, Change(magnitude=0.0, density=0.075), HALF, rng(seed))
        if operation is move_object:
            shift = (changed - before)[(changed != before).any(axis=1)].mean(axis=0)
        else:
            shift = changed[400:].mean(axis=0) - _cluster_mean(tile, seed)
        full = shift / [1, 1, share]
        assert np.linalg.norm(full) == pytest.approx(0.3, abs=1e-5 if operation is move_object else 0.06)


def _cluster_mean(tile: np.ndarray, seed: int) -> np.ndarray:
    kept = set(map(tuple, remove_object(tile, CHANGE, HALF, rng(seed))))
    return np.array([point for point in tile if tuple(point) not in kept]).mean(axis=0)


@pytest.mark.parametrize("operation", [add_object, move_object])
def test_nothing_leaves_the_tile(operation):
    edge = (rng().uniform(-1, 1, (400, 3)) * HALF).astype(np.float32)
    for seed in range(20):
        changed = operation(edge, Change(magnitude=0.5, density=0.3), HALF, rng(seed))
        assert (np.abs(changed) <= HALF).all()


def test_the_jitter_grows_with_the_magnitude():
    assert nuisance_sigma(0.5) == pytest.approx(0.026)
