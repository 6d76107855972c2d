"""The carrier: a mast on the robot, in rooms that differ from stop to stop."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.carrier import Carrier, CarrierSettings, floor_height

SETTINGS = CarrierSettings()
HEIGHT = 0.35  # metres of the sensor over the floor
MAST = (0.2, -0.1)  # x, y in the sensor frame


def on_sphere(count: int, seed: int) -> np.ndarray:
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def room(seed: int, *, wall: float = 2.5) -> np.ndarray:
    """Return what a sensor sees of a floor and of walls around it, sensor frame."""
    rays = on_sphere(6000, seed)
    with np.errstate(divide="ignore"):
        down = np.where(rays[:, 2] < 0, -HEIGHT / rays[:, 2], np.inf)
    return rays * np.minimum(down, wall)[:, None]


def mast(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([*MAST, 0.0]) + rng.uniform([-0.02, -0.02, -0.1], [0.02, 0.02, 0.3], (400, 3))


def test_what_repeats_near_the_sensor_is_the_carrier_and_the_floor_is_not() -> None:
    scans = [np.concatenate([room(seed), mast(seed)]) for seed in range(5)]
    hits = Carrier.of(scans, SETTINGS).hits(scans[0])
    assert hits[6000:].mean() > 0.98
    assert hits[:6000].mean() < 0.01


def test_a_thing_that_stands_near_to_some_stops_is_kept() -> None:
    post = np.array([0.4, 0.3, 0.0]) + np.random.default_rng(1).uniform(-0.05, 0.05, (200, 3))
    scans = [np.concatenate([room(seed), mast(seed)]) for seed in range(5)]
    scans[2] = np.concatenate([scans[2], post])
    hits = Carrier.of(scans, SETTINGS).hits(scans[2])
    assert not hits[-200:].any()


@pytest.mark.parametrize("count", [1, 2])
def test_of_few_scans_all_within_the_radius_is_cut_but_the_floor(count: int) -> None:
    scans = [np.concatenate([room(seed), mast(seed)]) for seed in range(count)]
    hits = Carrier.of(scans, SETTINGS).hits(scans[0])
    assert hits[6000:].all()
    floor = scans[0][:6000, 2] < -HEIGHT + 0.01
    assert not hits[:6000][floor].any()


def test_a_cloud_whose_origin_is_no_sensor_is_left_alone() -> None:
    walked = np.random.default_rng(3).uniform(-4, 4, (20_000, 3))
    for scans in ([walked], [np.concatenate([room(seed), mast(seed)]) for seed in range(5)]):
        assert not Carrier.of(scans, SETTINGS).hits(walked).any()


def test_a_radius_of_nothing_keeps_all() -> None:
    scans = [np.concatenate([room(seed), mast(seed)]) for seed in range(5)]
    assert not Carrier.of(scans, CarrierSettings(radius=0)).hits(scans[0]).any()


def test_the_floor_is_the_fullest_level_below_the_sensor() -> None:
    assert floor_height(room(0), SETTINGS) == pytest.approx(-HEIGHT, abs=0.01)
    assert floor_height(room(0)[room(0)[:, 2] > 0], SETTINGS) is None
