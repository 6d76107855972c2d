"""A round of a robot: where it stops, what it believes, and how seeds part."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.formats.scan import read_scan
from worker.simulation import visits
from worker.simulation.scenes import corridor, corridor_with_loop, rigid, small_office
from worker.simulation.scenes.mesh import box
from worker.simulation.sensor import PERFECT
from worker.simulation.visits import CLEARANCE, drifted, drifted_within, edited, merged, stops, visit


@pytest.mark.slow
@pytest.mark.parametrize(("make", "count"), [(small_office, 25), (corridor, 25), (corridor_with_loop, 42)])
@pytest.mark.parametrize("seed", [0, 7])
def test_stops_are_in_rooms_and_clear_of_everything(make, count, seed):
    scene = make(1)
    places = np.array([pose[:3, 3] for pose in stops(scene, count, seed=seed)])
    assert scene.caster.distances(places).min() > CLEARANCE - 0.05  # the robot's height varies by 1 cm
    for x, y, _ in places:
        assert any(
            np.all(np.array([x, y]) > r.low) and np.all(np.array([x, y]) < r.high) for r in scene.rooms
        )


def test_the_round_of_the_office_stops_in_every_room():
    scene = small_office(1)
    places = [pose[:2, 3] for pose in stops(scene, 20, seed=0)]
    for room in scene.rooms:
        assert any(np.all(place > room.low) and np.all(place < room.high) for place in places)


def test_another_seed_gives_other_poses_and_other_noise(bare_room):
    first, again, other = (visit(bare_room, 2, seed=seed, duration_s=0.1) for seed in (1, 1, 2))
    assert np.array_equal(first[0].points, again[0].points)
    assert not np.allclose(first[0].world_from_sensor, other[0].world_from_sensor)
    same_poses = tuple(seen.world_from_sensor for seen in first)
    repeated = visit(bare_room, same_poses, seed=2, duration_s=0.1)
    assert np.array_equal(repeated[0].world_from_sensor, first[0].world_from_sensor)
    assert not np.array_equal(repeated[0].points[:100], first[0].points[:100])


def test_without_prior_error_the_robot_believes_the_truth(bare_room):
    for seen in visit(bare_room, 2, seed=3, duration_s=0.05):
        assert np.array_equal(seen.prior, seen.world_from_sensor)


def test_priors_are_off_by_the_sigma_that_was_set():
    rng = np.random.default_rng(0)
    priors = np.array([drifted(np.eye(4), (0.2, 3.0), rng) for _ in range(400)])
    yaw = np.degrees(np.arctan2(priors[:, 1, 0], priors[:, 0, 0]))
    assert priors[:, :2, 3].std() == pytest.approx(0.2, rel=0.1)
    assert yaw.std() == pytest.approx(3.0, rel=0.1)


def test_bounded_drift_reaches_its_bounds_and_stays_within():
    rng = np.random.default_rng(0)
    true = rigid(3.0, -2.0, 0.35, yaw=80.0, pitch=0.5)
    priors = np.array([drifted_within(true, (0.25, 4.0), rng) for _ in range(400)])
    over_floor = np.linalg.norm(priors[:, :2, 3] - true[:2, 3], axis=1)
    assert 0.24 < over_floor.max() <= 0.25
    assert over_floor.mean() == pytest.approx(0.125, rel=0.1)
    assert 0.024 < np.abs(priors[:, 2, 3] - 0.35).max() <= 0.025
    turns = priors[:, :3, :3] @ true[:3, :3].T
    yaw = np.degrees(np.arctan2(turns[:, 1, 0], turns[:, 0, 0]))
    assert 3.9 < yaw.max() <= 4.0
    assert -3.9 > yaw.min() >= -4.0
    assert turns[:, 2, 2] == pytest.approx(1.0)  # about the vertical alone


def test_a_visit_drifts_as_it_is_told(bare_room):
    first = visit(bare_room, 3, seed=3, duration_s=0.05, prior_error=(0.2, 3.0), drift=drifted_within)
    for seen in first:
        off = np.linalg.norm((seen.prior - seen.world_from_sensor)[:2, 3])
        assert 0 < off <= 0.2


def test_merged_scans_without_noise_lie_on_the_scene():
    scene = small_office(2)
    points = merged(visit(scene, 4, seed=0, sensor=PERFECT, duration_s=0.2))
    assert scene.caster.distances(points.astype(np.float64)).max() < 1e-3


@pytest.mark.slow
def test_a_corridor_of_25_scans_holds_about_as_many_tiles_as_the_paper():
    points = merged(visit(corridor(1), 25, seed=5))
    voxels = np.unique(np.floor(points / 0.05).astype(np.int64), axis=0)
    tiles = np.floor((voxels * 0.05 - voxels.min(axis=0) * 0.05 + 0.025) / [1.5, 1.5, 1.0]).astype(int)
    counts = np.unique(tiles, axis=0, return_counts=True)[1]
    assert 150 <= np.sum(counts >= 512) <= 190


def test_a_visit_writes_its_scans_where_it_is_asked_to(bare_room, tmp_path):
    scans = visit(bare_room, 2, seed=3, duration_s=0.05, folder=tmp_path, name="stop-{:02d}")
    assert [scan.path for scan in scans] == [tmp_path / "stop-01.pcd", tmp_path / "stop-02.pcd"]
    for scan in scans:
        assert scan.path is not None
        assert np.array_equal(read_scan(scan.path).points, scan.points)
    assert [scan.path for scan in visit(bare_room, 2, seed=3, duration_s=0.05)] == [None, None]


def test_other_seeds_draw_other_edits_and_no_edits_leave_the_scene_as_it_is():
    office = small_office(5)
    assert edited(office, 0, seed=53, count=14)[0] is office
    first, second = (edited(office, 6, seed=seed, count=5)[0] for seed in (51, 52))
    assert {item.name for item in first.objects} != {item.name for item in second.objects}


def test_edits_that_leave_the_robot_no_way_are_drawn_again(monkeypatch: pytest.MonkeyPatch):
    drawn = []

    def walled_up_at_first(scene, *, seed, kinds):
        drawn.append(seed)
        block = box(9.0, 9.0, 2.0).at(5.0, 4.0)
        return scene.with_added("block", block) if len(drawn) == 1 else (scene, ())

    monkeypatch.setattr(visits, "random_edits", walled_up_at_first)
    before = small_office(5)
    after, poses = edited(before, 6, seed=51, count=14)
    assert after is before
    assert len(poses) == 14
    assert len(set(drawn)) == 2


def test_a_building_without_any_way_is_an_error(monkeypatch: pytest.MonkeyPatch):
    block = box(9.0, 9.0, 2.0).at(5.0, 4.0)
    monkeypatch.setattr(visits, "random_edits", lambda scene, **_: scene.with_added("block", block))
    with pytest.raises(ValueError, match="no free place"):
        edited(small_office(5), 6, seed=52, count=5)
