"""Glass lets rays through, a mirror turns them: in a room of known size."""

from __future__ import annotations

import numpy as np
import pytest

from worker.simulation.scenes import Scene, random_room, rigid, small_office
from worker.simulation.scenes.glazing import glazed
from worker.simulation.scenes.mesh import block
from worker.simulation.sensor import PERFECT, SensorModel, SimulatedScan, scan
from worker.simulation.visits import stops

POSE = rigid(2.0, 2.25, 0.35)  # looks along x, the east wall 4 m ahead
PANE = block((4.0, 0.5, 0.0), (4.01, 4.0, 3.0))


def measured(scene: Scene, sensor: SensorModel = PERFECT) -> SimulatedScan:
    return scan(scene, POSE, duration_s=1.0, sensor=sensor, rng=np.random.default_rng(0))


def test_a_mirror_shows_what_is_before_it_behind_itself(bare_room):
    scene, _ = bare_room.with_added("mirror", PANE, surface="mirror")
    scene, _ = scene.with_added("box", block((1.0, 2.0, 0.0), (1.5, 2.5, 0.8)))  # behind the sensor
    seen = measured(scene)
    shown = seen.world_points[seen.object_ids == scene["mirror"].object_id]
    assert len(shown) > 1000
    assert shown[:, 0].min() > 4.0
    # the wall at x = 0 is shown at x = 8, the face of the box at x = 1.5 at 6.5
    assert shown[:, 0].max() == pytest.approx(8.0, abs=0.01)
    off_walls = np.all((shown[:, 1:] > 0.02) & (shown[:, 1:] < (4.48, 2.98)), axis=1)
    face = (np.abs(shown[:, 0] - 6.5) < 0.01) & off_walls
    assert face.sum() > 20
    assert np.all((shown[face, 1] > 1.99) & (shown[face, 1] < 2.51))


def test_glass_sends_few_rays_back_and_more_where_they_meet_it_square(bare_room):
    scene, _ = bare_room.with_added("pane", PANE, surface="glass")
    seen = measured(scene)
    assert len(seen.points) == len(measured(bare_room).points)
    pane = seen.object_ids == scene["pane"].object_id
    behind = seen.world_points[:, 0] > 4.02
    share = pane.sum() / (pane.sum() + behind.sum())
    assert share == pytest.approx(0.05, abs=0.02)
    ahead = np.abs(seen.points[:, 1:]).max(axis=1) < 0.1 * seen.points[:, 0]
    square = pane[ahead].sum() / ahead.sum()
    assert square == pytest.approx(0.55, abs=0.15)
    assert seen.world_points[pane, 0] == pytest.approx(4.0, abs=2e-3)


def test_what_stands_before_a_pane_hides_it(bare_room):
    scene, _ = bare_room.with_added("pane", PANE, surface="glass")
    scene, _ = scene.with_added("board", block((3.0, 0.1, 0.0), (3.1, 4.4, 2.9)))
    assert not (measured(scene).object_ids == scene["pane"].object_id).any()


def test_a_scene_without_gloss_is_scanned_as_ever():
    seen = scan(
        random_room(3),
        rigid(2.0, 1.5, 0.35),
        duration_s=0.5,
        sensor=SensorModel(),
        rng=np.random.default_rng(1),
    )
    assert len(seen.points) == 10_041
    assert float(seen.points.astype(np.float64).sum()) == pytest.approx(REFERENCE_SUM, abs=1e-3)


#: Of all coordinates, in metres, as measured before there was glass.
REFERENCE_SUM = 25224.67062878464


@pytest.mark.parametrize("make", [random_room, small_office])
def test_a_glazed_building_leaves_a_way(make):
    scene = glazed(make(4), seed=1, panes=2, mirrors=2)
    added = [item for item in scene.objects if item.surface != "matt"]
    assert len(added) >= 2
    assert all(item.fixed for item in added)
    assert len(stops(scene, 5, seed=1)) == 5
