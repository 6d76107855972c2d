"""Buildings that are sound, and edits that say what they did."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from worker.simulation.scenes import (
    Scene,
    corridor,
    corridor_with_loop,
    edit_kinds,
    random_edits,
    random_room,
    random_solids,
    rigid,
    small_office,
)
from worker.simulation.scenes.edits import Place
from worker.simulation.scenes.mesh import box, cylinder, sphere
from worker.simulation.sensor import PERFECT, scan


def overlapping(scene: Scene) -> list[str]:
    """Movable pieces whose box runs into another object's."""
    return [o.name for o in scene.movable if not scene.is_free(o.mesh.bounds, ignoring=o.name)]


@pytest.mark.slow
@pytest.mark.parametrize("make", [small_office, corridor, corridor_with_loop, random_room])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pieces_stand_apart_inside_the_building(make, seed):
    scene = make(seed)
    assert len(scene.movable) >= 4
    assert overlapping(scene) == []
    assert min(item.mesh.bounds[0, 2] for item in scene.movable) == pytest.approx(0.0, abs=0.01)
    assert len({item.name for item in scene.objects}) == len({item.object_id for item in scene.objects})


def test_the_same_seed_gives_the_same_building_and_another_seed_another():
    first, again, other = small_office(3), small_office(3), small_office(4)
    assert [item.name for item in first.objects] == [item.name for item in again.objects]
    assert np.array_equal(first.objects[-1].mesh.vertices, again.objects[-1].mesh.vertices)
    assert not np.array_equal(first["wall-a"].mesh.vertices, other["wall-a"].mesh.vertices)


def test_the_office_measures_ten_by_eight_by_two_point_six_inside():
    scene = small_office(1)
    low = np.min([room.low for room in scene.rooms], axis=0)
    high = np.max([room.high for room in scene.rooms], axis=0)
    assert low.tolist() == [0.0, 0.0]
    assert high.tolist() == [10.0, 8.0]
    assert scene["ceiling-1"].mesh.bounds[0, 2] == pytest.approx(2.6)


@pytest.mark.slow
@pytest.mark.parametrize("make", [small_office, corridor, corridor_with_loop, random_room])
def test_no_ray_leaves_a_building(make):
    scene = make(2)
    x, y = np.mean([scene.rooms[-1].low, scene.rooms[-1].high], axis=0)
    seen = scan(scene, rigid(x, y, 2.2), duration_s=1.0, sensor=PERFECT, rng=np.random.default_rng(0))
    within_range = 21_600 if make is not corridor else 20_000  # the corridor's end may be out of reach
    assert within_range <= len(seen.points) <= 21_600
    low, high = scene.bounds
    assert np.all(seen.world_points > low) and np.all(seen.world_points < high)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_robot_can_walk_the_route_of_the_corridor_with_a_loop(seed):
    scene = corridor_with_loop(seed)
    route = np.array(scene.route)
    walked = np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(route)])
    for height in (0.35, 0.7, 1.2):
        room = scene.caster.distances(np.c_[walked, np.full(len(walked), height)])
        assert room.min() > 0.3


@pytest.mark.slow
def test_the_route_of_the_corridor_with_a_loop_leads_about_the_block_and_back():
    route = np.array(corridor_with_loop(1).route)
    legs = np.linalg.norm(np.diff(route, axis=0), axis=1)
    assert legs.sum() / 42 == pytest.approx(2.35, abs=0.01)  # between two of 42 stops
    assert np.array_equal(route[0], route[-1])
    loop = route[2:7]  # from the end of the second leg to there again
    assert np.array_equal(loop[0], loop[-1])
    from_block = loop[:-1] - (17.8 - 2.5, 20.2 + 2.0)  # its middle
    turned = np.diff(np.unwrap(np.arctan2(from_block[[0, 1, 2, 3, 0], 1], from_block[[0, 1, 2, 3, 0], 0])))
    assert abs(np.degrees(turned.sum())) == pytest.approx(360.0)


def test_solids_have_the_area_of_their_shape():
    def area(mesh) -> float:
        a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    assert area(box(1.0, 2.0, 3.0)) == pytest.approx(22.0)
    assert area(cylinder(0.5, 2.0, sides=64)) == pytest.approx(2 * np.pi * 0.25 + np.pi * 2.0, rel=0.01)
    assert area(sphere(0.5, sides=64)) == pytest.approx(np.pi, rel=0.01)


def test_an_added_box_is_hit_under_its_own_id(bare_room):
    scene, change = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(4.0, 1.5))
    seen = scan(scene, rigid(2.0, 1.5, 0.35), duration_s=1.0, sensor=PERFECT, rng=np.random.default_rng(0))
    hits = seen.world_points[seen.object_ids == scene["carton"].object_id]
    assert (change.kind, change.before) == ("add", None)
    assert change.after == pytest.approx(np.array([[3.75, 1.25, 0.0], [4.25, 1.75, 0.5]]))
    assert len(hits) > 100
    assert np.all(hits > change.after[0] - 1e-3) and np.all(hits < change.after[1] + 1e-3)


def test_a_removed_box_is_hit_no_more_and_its_id_is_not_given_again(bare_room):
    scene, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(4.0, 1.5))
    gone = scene["carton"].object_id
    scene, change = scene.without("carton")
    scene, _ = scene.with_added("other", box(0.2, 0.2, 0.2).at(1.0, 1.0))
    assert (change.kind, change.after) == ("remove", None)
    assert scene["other"].object_id == gone + 1
    with pytest.raises(KeyError, match="carton"):
        scene["carton"]


def test_a_shift_turns_a_piece_about_its_own_middle(bare_room):
    scene, _ = bare_room.with_added("plank", box(1.0, 0.2, 0.1).at(2.0, 2.0))
    moved, change = scene.shifted("plank", dx=0.5, dy=-0.25, yaw=90.0)
    assert change.kind == "move"
    assert change.before == pytest.approx(np.array([[1.5, 1.9, 0.0], [2.5, 2.1, 0.1]]))
    assert change.after == pytest.approx(np.array([[2.4, 1.25, 0.0], [2.6, 2.25, 0.1]]))
    assert moved["plank"].object_id == scene["plank"].object_id
    assert scene["plank"].mesh.bounds == pytest.approx(change.before)


def test_a_name_is_taken_once(bare_room):
    with pytest.raises(ValueError, match="floor"):
        bare_room.with_added("floor", box(1, 1, 1))


def test_random_edits_do_what_was_asked_and_leave_the_pieces_apart():
    scene = small_office(1)
    edited, changes = random_edits(scene, seed=5, kinds=("add", "remove", "move", "add"))
    assert [change.kind for change in changes] == ["add", "remove", "move", "add"]
    assert len({change.name for change in changes}) == 4
    assert len(edited.objects) == len(scene.objects) + 1
    assert overlapping(edited) == []


def test_a_scene_in_another_frame_keeps_names_and_ids_of_its_things(bare_room):
    moved = bare_room.placed(rigid(1.0))
    assert [(item.name, item.object_id) for item in moved.objects] == [
        (item.name, item.object_id) for item in bare_room.objects
    ]
    assert moved.bounds[0, 0] == bare_room.bounds[0, 0] + 1.0


def test_edits_take_turns():
    assert edit_kinds(4) == ("add", "remove", "move", "add")


def test_random_solids_keep_to_their_sizes_and_places():
    scene = small_office(1)
    bands: dict[Place, tuple[float, float]]
    bands = {"floor": (0.0, 0.0), "furniture": (0.1, 2.6), "air": (0.3, 2.6)}
    for place, (low, high) in bands.items():
        after, changes = random_solids(scene, seed=5, count=12, places=(place,))
        assert len(changes) >= 8
        assert {change.kind for change in changes} == {"add"}
        added = [after[change.name].mesh for change in changes]
        assert all(low <= mesh.bounds[0, 2] <= high for mesh in added)
        assert all(mesh.bounds[1, 2] <= 2.6 - 0.15 + 1e-9 for mesh in added)
        # of a turned box the box along the axes is longer, by at most the square root of two
        assert all(np.ptp(mesh.bounds, axis=0).max() <= 1.2 * np.sqrt(2) for mesh in added)
        if place != "furniture":
            assert overlapping(after) == []


def test_a_solid_on_furniture_rests_on_it():
    room = random_room(3)
    after, changes = random_solids(room, seed=1, count=10, places=("furniture",), size=(0.12, 0.2))
    assert changes
    for change in changes:
        low, high = after[change.name].mesh.bounds
        x, y = np.meshgrid(*np.linspace(low[:2], high[:2], 12).T)
        origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, low[2] + 1e-3)], axis=1)
        below = room.caster.cast(origins, np.tile([0.0, 0.0, -1.0], (len(origins), 1)))
        assert below.ranges.min() < 0.02


def test_random_solids_are_a_function_of_their_seed():
    room = random_room(3)
    (first, _), (again, _), (other, _) = (random_solids(room, seed=seed, count=4) for seed in (1, 1, 2))
    assert [item.name for item in first.objects] == [item.name for item in again.objects]
    assert np.array_equal(first.objects[-1].mesh.vertices, again.objects[-1].mesh.vertices)
    assert not np.array_equal(first.objects[-1].mesh.vertices, other.objects[-1].mesh.vertices)
