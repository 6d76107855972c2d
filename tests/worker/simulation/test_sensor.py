"""One scan: its pattern, its noise and its losses, each against numbers set in the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from worker.simulation.scenes import Scene, SceneObject, rigid
from worker.simulation.scenes.mesh import block
from worker.simulation.sensor import PERFECT, SensorModel, SimulatedScan, directions, scan

SIZE = np.array([6.0, 4.5, 3.0])
POSE = rigid(2.0, 1.5, 0.35, yaw=30.0, pitch=2.0)


def measure(
    scene: Scene, sensor: SensorModel, *, seed: int = 0, pose=POSE, seconds: float = 1.0
) -> SimulatedScan:
    return scan(scene, pose, duration_s=seconds, sensor=sensor, rng=np.random.default_rng(seed))


def distance_to_wall(points: np.ndarray) -> np.ndarray:
    """(N,) metres to the nearest of the six planes of the bare room."""
    return np.abs(np.concatenate([points, points - SIZE], axis=1)).min(axis=1)


def wall_ahead(distance: float) -> Scene:
    wall = block((distance, -20.0, -20.0), (distance + 0.1, 20.0, 20.0))
    return Scene(name="wall", objects=(SceneObject(name="wall", object_id=7, mesh=wall),))


def test_five_seconds_fire_108000_rays_in_the_half_space_around_the_axis():
    sensor = SensorModel()
    rays = directions(sensor, 5.0, np.random.default_rng(0))
    tilt = np.radians(sensor.axis_elevation_deg)
    along_axis = rays @ np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    assert rays.shape == (108_000, 3)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    assert along_axis.min() >= -1e-9
    assert along_axis.min() < 0.01 and along_axis.max() > 0.9999


def test_neighbours_on_a_line_are_one_and_a_half_degrees_apart():
    still = replace(PERFECT, turns_per_second=0.0)
    rays = directions(still, 0.1, np.random.default_rng(0))[:120]
    steps = np.degrees(np.arccos(np.sum(rays[1:] * rays[:-1], axis=1)))
    assert steps == pytest.approx(1.5, abs=1e-6)


def test_without_noise_every_point_lies_on_a_wall_of_the_room(bare_room):
    seen = measure(bare_room, PERFECT)
    assert len(seen.points) == 21_600
    assert distance_to_wall(seen.world_points).max() < 1e-3


def test_ids_name_the_wall_that_a_point_lies_on(bare_room):
    seen = measure(bare_room, PERFECT)
    away = np.abs(np.stack([seen.world_points, seen.world_points - SIZE], axis=1)).reshape(-1, 6)
    clear = np.sort(away, axis=1)[:, 1] > 0.01  # points in a corner belong to either wall
    names = np.array(["west", "south", "floor", "east", "north", "ceiling"])
    expected = [bare_room[name].object_id for name in names[away.argmin(axis=1)]]
    assert np.array_equal(seen.object_ids[clear], np.array(expected)[clear])
    assert set(seen.object_ids) == {1, 2, 3, 4, 5, 6}


def test_range_residuals_have_the_sigma_that_was_set(bare_room):
    exact = measure(bare_room, PERFECT)
    noisy = measure(bare_room, replace(PERFECT, range_sigma=0.02))
    residuals = np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(exact.points, axis=1)
    assert residuals.std() == pytest.approx(0.02, rel=0.1)
    assert abs(residuals.mean()) < 0.001


def test_one_scan_has_one_bias_and_many_have_its_sigma(bare_room):
    sensor = replace(PERFECT, bias_sigma=0.01)
    biases = []
    for seed in range(60):
        exact = measure(bare_room, PERFECT, seed=seed, seconds=0.05)
        shifted = measure(bare_room, sensor, seed=seed, seconds=0.05)
        residuals = np.linalg.norm(shifted.points, axis=1) - np.linalg.norm(exact.points, axis=1)
        assert np.ptp(residuals) < 1e-5
        biases.append(residuals.mean())
    assert np.std(biases) == pytest.approx(0.01, rel=0.3)


def test_ranges_are_whole_millimetres(bare_room):
    seen = measure(bare_room, replace(PERFECT, range_sigma=0.015, range_step=0.001))
    millimetres = np.linalg.norm(seen.points.astype(np.float64), axis=1) * 1000
    assert np.abs(millimetres - millimetres.round()).max() < 0.01


@pytest.mark.parametrize(
    ("distance", "share"), [(3.0, 0.94), (7.0, 0.6 * 0.94), (9.95, 0.2 * 0.94), (15.1, 0.0)]
)
def test_returns_are_certain_near_by_and_fall_to_a_fifth_at_ten_metres(distance, share):
    narrow = SensorModel(field_deg=8.0, axis_elevation_deg=0.0)
    seen = measure(wall_ahead(distance), narrow, pose=np.eye(4))
    assert len(seen.points) / 21_600 == pytest.approx(share, abs=0.02)


def test_nothing_is_seen_nearer_than_the_least_range():
    narrow = replace(PERFECT, field_deg=8.0, axis_elevation_deg=0.0)
    assert len(measure(wall_ahead(0.04), narrow, pose=np.eye(4)).points) == 0
    assert len(measure(wall_ahead(0.06), narrow, pose=np.eye(4)).points) == 21_600


def test_grazing_rays_return_in_proportion_to_their_cosine():
    floor = block((-50.0, -50.0, -1.0), (50.0, 50.0, 0.0))
    scene = Scene(name="floor", objects=(SceneObject(name="floor", object_id=1, mesh=floor),))

    def at_85_degrees(grazing_deg: float) -> int:
        sensor = replace(PERFECT, grazing_deg=grazing_deg)
        points = measure(scene, sensor, pose=rigid(z=0.35), seconds=5.0).points
        angles = np.degrees(np.arctan2(np.linalg.norm(points[:, :2], axis=1), 0.35))
        return int(np.sum(np.abs(angles - 85.0) < 0.5))

    share = at_85_degrees(75.0) / at_85_degrees(90.0)
    assert share == pytest.approx(np.cos(np.radians(85)) / np.cos(np.radians(75)), abs=0.05)


def test_edges_of_depth_mix_and_plain_walls_do_not(bare_room):
    scene, _ = bare_room.with_added("board", block((5.6, 1.5, 0.5), (5.65, 3.0, 2.0)))
    mixes = replace(PERFECT, mixing=1.0)
    clean, mixing, plain = (
        measure(where, sensor, seconds=5.0)
        for where, sensor in ((scene, PERFECT), (scene, mixes), (bare_room, mixes))
    )

    def stray(seen: SimulatedScan) -> int:
        return int(np.sum(scene.caster.distances(seen.world_points) > 0.02))

    assert stray(clean) == 0
    assert stray(mixing) > 50
    assert stray(plain) < 10  # a beam that grazes the floor just before a wall may mix both


def test_the_same_seed_gives_the_same_scan_and_another_seed_another(bare_room):
    first, again, other = (measure(bare_room, SensorModel(), seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.points, again.points)
    assert np.array_equal(first.object_ids, again.object_ids)
    assert first.points.shape != other.points.shape or not np.allclose(first.points, other.points, atol=0.1)


def test_floor_walls_and_ceiling_are_all_seen_from_35_centimetres(bare_room):
    seen = measure(bare_room, SensorModel(), seconds=5.0)
    for name in ("floor", "ceiling"):
        assert np.mean(seen.object_ids == bare_room[name].object_id) > 0.05
