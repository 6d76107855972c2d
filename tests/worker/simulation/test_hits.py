"""What changed by the hits of two visits, in a bare room with things of known size."""

from __future__ import annotations

import numpy as np
import pytest

from worker.cloud.voxel_keys import centers, unpacked
from worker.simulation.company import FIRST_PERSON_ID, Walker
from worker.simulation.hits import Visit, hit_truth, passing_rays
from worker.simulation.scenes import Scene, rigid
from worker.simulation.scenes.mesh import block
from worker.simulation.sensor import PERFECT, SimulatedScan, scan
from worker.simulation.truth import KINDS

POSE = rigid(1.0, 2.25, 0.35)
CARTON = block((3.0, 2.0, 0.0), (3.5, 2.5, 0.5))


def seen(room: Scene, pose=POSE, **company) -> list[SimulatedScan]:
    rng = np.random.default_rng(0)
    return [scan(room, pose, duration_s=3.0, sensor=PERFECT, rng=rng, **company)]


def truth(before: Scene, after: Scene, first, second, map_from_world=None):
    return hit_truth(
        before, after, first, second, map_from_world=np.eye(4) if map_from_world is None else map_from_world
    )


@pytest.fixture
def with_carton(bare_room) -> Scene:
    scene, _ = bare_room.with_added("carton", CARTON)
    return scene


def test_an_added_box_appears_where_it_was_hit_and_the_first_visit_saw_through(bare_room, with_carton):
    told = truth(bare_room, with_carton, seen(bare_room), seen(with_carton))
    assert [(KINDS[thing.kind], thing.size) for thing in told.things] == [("add", pytest.approx(0.5))]
    assert set(told.object_ids.tolist()) == {with_carton["carton"].object_id}
    assert set(told.visit.tolist()) == {Visit.SECOND}
    middles = centers(told.keys, 0.05)
    assert np.all(middles > np.array([2.95, 1.95, 0.05])) and np.all(middles < [3.55, 2.55, 0.55])
    # The front is ten by ten voxels less what lies within 7.5 cm of the floor: 90 at most; the top comes beside it.
    front = unpacked(told.keys)[:, 0] <= 60
    assert 60 <= front.sum() <= 2 * 90
    assert told.decidable.mean() > 0.9


def test_the_same_edit_the_other_way_round_has_disappeared(bare_room, with_carton):
    added = truth(bare_room, with_carton, seen(bare_room), seen(with_carton))
    removed = truth(with_carton, bare_room, seen(with_carton), seen(bare_room))
    assert KINDS[removed.things[0].kind] == "remove"
    assert set(removed.visit.tolist()) == {Visit.FIRST}
    assert np.array_equal(removed.keys, added.keys)
    assert np.array_equal(removed.decidable, added.decidable)


def test_what_the_other_visit_could_not_look_through_is_not_decidable(bare_room, with_carton):
    board = block((2.0, 0.1, 0.0), (2.05, 4.4, 2.9))
    screened, _ = bare_room.with_added("board", board)
    told = truth(bare_room, with_carton, seen(screened), seen(with_carton))
    assert len(told.keys) > 60
    assert not told.decidable.any()
    away = seen(bare_room, rigid(2.8, 2.25, 0.35, yaw=180.0))  # looks the other way
    assert not truth(bare_room, with_carton, away, seen(with_carton)).decidable.any()


def test_a_thing_moved_by_less_than_its_size_changed_on_both_sides_only(bare_room, with_carton):
    after, _ = with_carton.shifted("carton", dy=0.3)
    told = truth(with_carton, after, seen(with_carton), seen(after))
    assert KINDS[told.things[0].kind] == "move"
    for visit, low, high in ((Visit.FIRST, 1.95, 2.3), (Visit.SECOND, 2.5, 2.85)):
        y = centers(told.keys[told.visit == visit], 0.05)[:, 1]
        assert len(y) > 20
        inside = (y > low) & (y < high)
        assert inside.mean() > 0.7  # the front stays in one plane; tops and flanks are new there too


def test_a_visit_without_edits_has_no_change_whoever_walks_by(bare_room):
    walker = Walker(object_id=FIRST_PERSON_ID, way=np.array([[3.0, 0.5], [3.0, 4.0]]), start=0.5, pace=1.0)
    told = truth(bare_room, bare_room, seen(bare_room), seen(bare_room, walkers=[walker]))
    assert not len(told.keys)
    assert not len(told.surface)
    assert told.things == ()


def test_keys_are_of_the_map_frame(bare_room, with_carton):
    first, second = seen(bare_room), seen(with_carton)
    here = truth(bare_room, with_carton, first, second)
    there = truth(bare_room, with_carton, first, second, rigid(1.0, -2.0, 0.5))
    assert np.array_equal(unpacked(there.keys), unpacked(here.keys) + np.array([20, -40, 10]))
    assert np.array_equal(there.decidable, here.decidable)


def test_surface_holds_backs_that_nobody_hit_and_no_contact_face(bare_room, with_carton):
    told = truth(bare_room, with_carton, seen(bare_room), seen(with_carton))
    cells = unpacked(told.surface)
    assert cells[:, 0].max() >= 69  # the back at x = 3.5
    assert cells[:, 2].min() == 0  # flanks from 2 cm up, but not the underside
    inside = (cells[:, 0] > 61) & (cells[:, 0] < 68) & (cells[:, 1] > 41) & (cells[:, 1] < 48)
    assert not (inside & (cells[:, 2] == 0)).any()


def test_rays_tell_of_a_place_that_they_pass_within_four_centimetres_and_leave_behind(bare_room):
    one = SimulatedScan(
        points=np.array([[3.0, 0.0, 0.0], [3.0, 0.09, 0.0]], np.float32),
        object_ids=np.array([4, 4], np.int32),
        world_from_sensor=np.eye(4),
        prior=np.eye(4),
    )
    places = np.array(
        [[1.5, 0.0, 0.0], [1.5, 0.02, 0.0], [1.5, 0.06, 0.0], [1.5, 0.09, 0.0], [2.95, 0.0, 0.0], [-1, 0, 0]]
    )
    # the second ray is 4.5 cm aside at x = 1.5
    assert passing_rays(places, bare_room, [one]).tolist() == [1, 2, 1, 0, 0, 0]


def test_rays_that_a_mirror_turned_tell_nothing(bare_room):
    scene, _ = bare_room.with_added("mirror", block((4.0, 0.5, 0.0), (4.01, 4.0, 3.0)), surface="mirror")
    place = np.array([[5.0, 2.25, 0.35]])  # behind the mirror
    assert passing_rays(place, scene, seen(scene)).tolist() == [0]
    assert passing_rays(place, bare_room, seen(bare_room))[0] > 0
