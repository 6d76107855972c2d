"""Places that look alike: what they share is the very same, and the rest is not."""

from __future__ import annotations

import numpy as np
import pytest

from worker.simulation.scenes import (
    Scene,
    changed,
    corridor,
    hotel_corridor,
    hotel_room,
    random_room,
    refurnished,
    small_office,
)
from worker.simulation.visits import stops


def fixed(scene: Scene) -> dict[str, bytes]:
    return {item.name: item.mesh.vertices.tobytes() for item in scene.objects if item.fixed}


def standing(scene: Scene) -> dict[str, bytes]:
    return {
        item.name: item.mesh.vertices.tobytes()
        for item in scene.movable
        if float(item.mesh.bounds[0, 2]) < 0.01
    }


def overlapping(scene: Scene) -> list[str]:
    return [o.name for o in scene.movable if not scene.is_free(o.mesh.bounds, ignoring=o.name)]


@pytest.mark.parametrize("make", [random_room, corridor, small_office])
def test_a_refurnished_place_has_the_same_shell_and_no_piece_where_one_was(make):
    before = make(4)
    after = refurnished(before, 7)
    assert fixed(after) == fixed(before)
    assert len(after.movable) >= 4
    assert not set(standing(after).values()) & set(standing(before).values())
    assert overlapping(after) == []
    assert len({item.object_id for item in after.objects}) == len(after.objects)
    assert len(stops(after, 6, seed=1)) == 6


def test_a_refurnished_place_is_drawn_by_its_seed():
    room = random_room(4)
    assert standing(refurnished(room, 7)) == standing(refurnished(room, 7))
    assert standing(refurnished(room, 7)) != standing(refurnished(room, 8))


def test_doors_of_a_hotel_corridor_stand_opposite_each_other_at_even_distances():
    scene = hotel_corridor(3)
    length, width = scene.rooms[0].high
    assert 18 <= length <= 22 and 2.1 <= width <= 2.3
    sides = [
        np.sort([o.mesh.bounds[0, 0] for o in scene.objects if o.name.startswith(f"wall-{side}-door")])
        for side in ("south", "north")
    ]
    assert len(sides[0]) >= 4
    apart = np.diff(sides[0])
    assert np.allclose(apart, apart[0]) and 3.2 <= apart[0] <= 4.2
    assert np.allclose(sides[0], sides[1], atol=1e-6)
    assert len(stops(scene, 12, seed=1)) == 12


def test_floors_of_a_hotel_have_the_same_shell_and_other_hotels_another():
    assert fixed(hotel_corridor(3)) == fixed(hotel_corridor(3, floor=1))
    assert standing(hotel_corridor(3)) != standing(hotel_corridor(3, floor=1))
    assert fixed(hotel_corridor(3)) != fixed(hotel_corridor(4))


def test_even_rooms_of_a_hotel_have_the_same_shell_and_their_furniture_within_some_decimetres():
    first, third = hotel_room(3), hotel_room(3, number=2)
    assert fixed(first) == fixed(third)
    assert {item.name for item in first.movable} == {item.name for item in third.movable}
    off = [
        np.linalg.norm((third[item.name].mesh.bounds - item.mesh.bounds).mean(axis=0))
        for item in first.movable
    ]
    assert 0.05 < np.median(off) < 0.3 and max(off) < 0.7


def test_odd_rooms_of_a_hotel_are_mirrored():
    first, second = hotel_room(3), hotel_room(3, number=1)
    width = first.rooms[0].high[0]
    for name in ("bath", "bed-1", "desk-1", "radiator"):
        there = first[name].mesh.bounds.mean(axis=0)
        here = second[name].mesh.bounds.mean(axis=0)
        assert here[0] == pytest.approx(width - there[0], abs=0.6)
        assert here[1] == pytest.approx(there[1], abs=0.6)
    assert overlapping(second) == []


@pytest.mark.parametrize("share", [0.0, 0.25, 0.4])
def test_a_share_of_what_stands_is_changed_and_as_much_stands_there_afterwards(share):
    before = small_office(4)
    after = changed(before, share, seed=5)
    was, now = standing(before), standing(after)
    touched = sum(now.get(name) != mesh for name, mesh in was.items())
    assert share * len(was) - 2 <= touched <= share * len(was) + 1
    assert abs(len(now) - len(was)) <= 2  # what found no place
    assert fixed(after) == fixed(before)
    assert overlapping(after) == []


def test_a_changed_place_has_moved_gone_and_exchanged_pieces():
    before = small_office(4)
    after = changed(before, 0.4, seed=5)
    gone = set(standing(before)) - set(standing(after))
    new = set(standing(after)) - set(standing(before))
    moved = [name for name, mesh in standing(before).items() if standing(after).get(name, mesh) != mesh]
    assert len(gone) >= 4 and len(new) >= 4 and len(moved) >= 2
    middles = [before[name].mesh.bounds.mean(axis=0)[:2] for name in gone]
    kept_places = [
        min(np.linalg.norm(after[name].mesh.bounds.mean(axis=0)[:2] - there) for there in middles) < 0.3
        for name in new
    ]
    assert any(kept_places) and not all(kept_places)


def test_a_room_has_the_size_that_is_asked_for_and_the_seeds_furniture_otherwise():
    room = random_room(4, size=(5.0, 4.0, 2.5))
    assert room.rooms[0].high == (5.0, 4.0)
    assert room["ceiling-1"].mesh.bounds[0, 2] == pytest.approx(2.5)
