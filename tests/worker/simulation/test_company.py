"""People who walk through a scan, and the robot that its own sensor sees."""

from __future__ import annotations

import numpy as np
import pytest

from worker.simulation.company import CARRIER_ID, FIRST_PERSON_ID, CarrierBody, Walker, walkers
from worker.simulation.scenes import Scene, rigid
from worker.simulation.sensor import PERFECT, SensorModel, scan
from worker.simulation.visits import visit

POSE = rigid(1.0, 2.25, 0.35)


def passing(pace: float) -> Walker:
    """Across the view, 2 m ahead of the sensor."""
    return Walker(object_id=FIRST_PERSON_ID, way=np.array([[3.0, 0.5], [3.0, 4.0]]), start=0.5, pace=pace)


def measured(room: Scene, sensor: SensorModel = PERFECT, **company):
    return scan(room, POSE, duration_s=2.0, sensor=sensor, rng=np.random.default_rng(0), **company)


def test_a_person_who_walks_is_smeared_along_the_way(bare_room):
    widths = []
    for pace in (0.0, 1.0):
        seen = measured(bare_room, walkers=[passing(pace)])
        body = seen.world_points[seen.object_ids == FIRST_PERSON_ID]
        assert len(body) > 200
        assert body[:, 0] == pytest.approx(3.0, abs=0.3)
        widths.append(float(np.ptp(body[:, 1])))
    assert widths[0] < 0.45
    assert widths[1] == pytest.approx(widths[0] + 2.0, abs=0.25)


def test_a_person_turns_round_at_the_end_of_the_way():
    place, ahead = passing(-1.0).at(np.array([0.0, 0.5, 1.0, 2.0]))
    assert place[:, 1] == pytest.approx([1.0, 0.5, 1.0, 2.0])
    assert place[:, 0] == pytest.approx(3.0)
    assert ahead[0] == pytest.approx([0.0, -1.0])


def test_noise_and_losses_are_as_without_company(bare_room):
    alone = measured(bare_room, SensorModel())
    seen = measured(bare_room, SensorModel(), walkers=[passing(1.0)], carrier=CarrierBody.random(1))
    building = seen.points[seen.object_ids > 0]
    same = {tuple(point) for point in alone.points.tolist()}
    kept = [tuple(point) in same for point in building.tolist()]
    assert np.mean(kept) > 0.99  # at the rim of what hides it the beam mixes with other surfaces


def test_the_carrier_is_met_at_the_same_place_in_every_scan(bare_room):
    carrier = CarrierBody.random(3)
    scans = visit(bare_room, 3, seed=4, sensor=PERFECT, duration_s=1.0, carrier=carrier)
    low, high = carrier.mesh.bounds
    for seen in scans:
        own = seen.points[seen.object_ids == CARRIER_ID]
        assert len(own) > 100
        assert np.all(own > low - 1e-3) and np.all(own < high + 1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_a_carrier_stands_between_20_and_70_cm_from_the_sensor(seed, bare_room):
    seen = measured(bare_room, carrier=CarrierBody.random(seed))
    ranges = np.linalg.norm(seen.points[seen.object_ids == CARRIER_ID], axis=1)
    assert ranges.min() >= 0.2 and ranges.max() <= 0.7


def test_other_people_walk_past_every_stop_and_begin_nearby(bare_room):
    first, other = (walkers(bare_room, POSE, 2, np.random.default_rng(seed)) for seed in (1, 2))
    assert [walker.object_id for walker in first] == [FIRST_PERSON_ID, FIRST_PERSON_ID - 1]
    assert first[0].start != other[0].start
    scans = visit(bare_room, 2, seed=4, sensor=PERFECT, duration_s=1.0, people=3)
    assert all((seen.object_ids <= FIRST_PERSON_ID).any() for seen in scans)


def test_nobody_walks_where_there_is_no_route(bare_room):
    with pytest.raises(ValueError, match="no route"):
        walkers(Scene(name="closet", objects=bare_room.objects), POSE, 1, np.random.default_rng(0))
