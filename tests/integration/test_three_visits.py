"""Three visits in a row, as a facility manager would read them: one thing moved, one taken, one brought back."""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import combinations

import numpy as np
import pytest

from service.catalog.findings.objects import ObjectFilter
from service.catalog.records import MapObjectRecord
from tests.support.house import SETTINGS, House, run
from worker.detectors.card import MODEL_STORE
from worker.simulation.scenes import Scene, SceneObject, random_room
from worker.simulation.visits import visit

MODEL, PLACE = "voxel-net/1", "den"


def large_things(scene: Scene) -> list[SceneObject]:
    """What stands on the floor, of at least 40 cm each way, and far from each other."""
    large = [
        item
        for item in scene.movable
        if item.mesh.bounds[0, 2] < 0.01 and (np.ptp(item.mesh.bounds, axis=0) > 0.4).all()
    ]
    for pair in combinations(large, 2):
        first, second = (item.mesh.bounds.mean(axis=0)[:2] for item in pair)
        if np.linalg.norm(first - second) > 2.0:
            return list(pair)
    raise AssertionError("no two things stand apart")


def pushed(scene: Scene, name: str) -> Scene:
    """Push a thing by 60 cm or more to a free place, and turn it."""
    rng = np.random.default_rng(0)
    room = scene.rooms[0]
    for _ in range(500):
        turn = rng.uniform(0, 2 * np.pi)
        way = rng.uniform(0.6, 1.2) * np.array([np.cos(turn), np.sin(turn)])
        later, change = scene.shifted(name, dx=float(way[0]), dy=float(way[1]), yaw=15)
        assert change.after is not None
        inside = (change.after[0, :2] > room.low).all() and (change.after[1, :2] < room.high).all()
        if inside and scene.is_free(change.after, ignoring=name):
            return later
    raise AssertionError("no place to push it to")


@pytest.fixture
def told(house: House, monkeypatch: pytest.MonkeyPatch) -> list[MapObjectRecord]:
    monkeypatch.setenv("SPICD_MODEL_STORE", str(MODEL_STORE))
    before = random_room(21)
    moved, taken = (item.name for item in large_things(before))
    first = pushed(before, moved)
    second, _ = first.without(taken)
    scans = visit(before, 6, seed=1)
    ids = [house.add(f"den-{number}.pcd", scan).scan_id for number, scan in enumerate(scans)]
    run(house.catalog.maps.create(scan_ids=ids, model=MODEL, map_id=PLACE, settings=SETTINGS)[1])
    for day, scene in enumerate((first, second, first), start=2):
        scans = visit(scene, 5, seed=10 + day)
        ids = [house.add(f"day-{day}-{number}.pcd", scan).scan_id for number, scan in enumerate(scans)]
        when = datetime(2026, 3, day, 12, tzinfo=UTC)
        run(house.catalog.surveys.create(PLACE, scan_ids=ids, model=MODEL, captured_at=when)[1])
    return list(house.catalog.objects.page(ObjectFilter(map_id=PLACE)).items)


def test_the_objects_of_the_map_tell_what_happened_and_nothing_else(told: list[MapObjectRecord]) -> None:
    story = {
        (one.latest.thing.kind, one.status, one.first_seen.day, one.last_seen.day, one.sightings)
        for one in told
    }
    assert story == {("moved", "still_there", 2, 4, 3), ("disappeared", "gone_again", 3, 3, 1)}
    assert len(told) == 2
