"""One room that is really walked, mapped, edited and surveyed, by three stops a visit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from worker.benchmarks.revisit import second_visit
from worker.benchmarks.revisit.plan import RevisitSettings, SitePlan, VisitPlan, plan_visits
from worker.benchmarks.revisit.second_visit import edited, kept_tiles, second_stops, true_changes
from worker.benchmarks.revisit.visits import make_visits
from worker.cloud.tiling import TileGrid
from worker.simulation.scenes import rigid
from worker.simulation.scenes.mesh import box

OFFICE = SitePlan(kind="office", seed=5)


def test_poses_come_from_registration_and_are_near_the_truth(walked):
    for visit in walked.values():
        assert visit.first.accepted == visit.first.scans == 3
        assert visit.second.accepted > 0
        assert np.nanmedian(visit.misfit) < 0.03
        assert 0 < np.median(visit.second.metres) < 0.02  # one may well be wrong: so few stops


def test_a_visit_without_changes_has_no_positives(walked):
    quiet = walked["unchanged"]
    assert not quiet.cells.any()
    assert not quiet.changed.any()
    assert quiet.outside == 0
    assert quiet.counted.tolist() == quiet.pairs.observed.tolist()


def test_edits_make_changed_tiles_and_what_is_in_sight_exists(walked):
    visit = walked["changed"]
    assert visit.exists.any()
    assert np.all(visit.in_sight <= visit.cells)


def test_visits_share_the_map_and_not_what_they_saw(walked):
    first, second = walked["changed"].pairs, walked["unchanged"].pairs
    assert all(
        np.array_equal(a, b) for a, b in zip(first.reference.points, second.reference.points, strict=True)
    )
    assert not any(
        len(a) and np.array_equal(a, b) for a, b in zip(first.current, second.current, strict=True)
    )


def test_fewer_stops_leave_more_tiles_unobserved(walked):
    assert walked["sparse"].second.scans == 1
    assert walked["sparse"].pairs.observed.sum() < walked["unchanged"].pairs.observed.sum()


def test_visits_that_are_there_are_not_made_again(visits_folder: Path):
    settings = RevisitSettings(kinds=("room",), stops={"room": 3}, edits={"room": 3}, standing_s=2.0)
    _, made = make_visits(plan_visits(3, settings, first_seed=51), settings, visits_folder)
    assert made == 0


def test_a_third_of_the_stops_and_no_edit_where_the_case_says_so():
    settings = RevisitSettings()
    stops = {
        case: second_stops(VisitPlan(site=OFFICE, case=case), settings) for case in ("changed", "sparse")
    }
    assert stops == {"changed": 14, "sparse": 5}
    before = OFFICE.scene()
    assert edited(before, VisitPlan(site=OFFICE, case="unchanged"), settings)[0] is before
    names = [
        {item.name for item in edited(before, VisitPlan(site=OFFICE, case=case), settings)[0].objects}
        for case in ("changed", "sparse")
    ]
    assert names[0] != names[1]


def test_edits_that_leave_the_robot_no_way_are_drawn_again(monkeypatch: pytest.MonkeyPatch):
    drawn = []

    def walled_up_at_first(scene, *, seed, kinds):
        drawn.append(seed)
        block = box(9.0, 9.0, 2.0).at(5.0, 4.0)
        return scene.with_added("block", block) if len(drawn) == 1 else (scene, ())

    monkeypatch.setattr(second_visit, "random_edits", walled_up_at_first)
    before = OFFICE.scene()
    after, poses = edited(before, VisitPlan(site=OFFICE, case="changed"), RevisitSettings())
    assert after is before
    assert len(poses) == 14
    assert len(set(drawn)) == 2


def test_a_building_without_any_way_is_an_error(monkeypatch: pytest.MonkeyPatch):
    block = box(9.0, 9.0, 2.0).at(5.0, 4.0)
    monkeypatch.setattr(second_visit, "random_edits", lambda scene, **_: scene.with_added("block", block))
    with pytest.raises(ValueError, match="no free place"):
        edited(OFFICE.scene(), VisitPlan(site=OFFICE, case="sparse"), RevisitSettings())


def test_the_truth_follows_the_scene_into_the_frame_of_the_map(bare_room):
    after, _ = bare_room.with_added("carton", box(0.5, 0.5, 0.5).at(2.25, 3.75))
    map_from_world = rigid(10.0, 20.0, 1.0, yaw=90)  # the carton's middle goes to (6.25, 22.25, 1.25)
    grid = TileGrid(origin=np.array([5.5, 20.0, 1.0]), size=np.array([1.5, 1.5, 1.0]), shape=(3, 4, 3))
    near = map_from_world @ rigid(2.25, 2.0, 0.35)
    exists, visible = true_changes(bare_room, after, grid, map_from_world, [near], [near])
    assert np.argwhere(exists.changed).tolist() == [[0, 1, 0]]
    assert np.argwhere(visible.changed).tolist() == [[0, 1, 0]]
    assert visible.cells.sum() < exists.cells.sum()  # not the side that is turned away


def test_a_change_behind_a_screen_exists_and_is_in_nobodys_sight(bare_room):
    screened, _ = bare_room.with_added("screen", box(0.1, 4.5, 3.0).at(3.05, 2.25))
    after, _ = screened.with_added("carton", box(0.5, 0.5, 0.5).at(5.25, 0.75))
    grid = TileGrid(origin=np.zeros(3), size=np.array([1.5, 1.5, 1.0]), shape=(4, 3, 3))
    sensors = [rigid(1.0, 1.0, 0.35)]
    exists, visible = true_changes(screened, after, grid, np.eye(4), sensors, sensors)
    assert np.argwhere(exists.changed).tolist() == [[3, 0, 0]]
    assert not visible.changed.any()


def test_a_scene_in_another_frame_keeps_names_and_ids_of_its_things(bare_room):
    moved = bare_room.placed(rigid(1.0))
    assert [(item.name, item.object_id) for item in moved.objects] == [
        (item.name, item.object_id) for item in bare_room.objects
    ]
    assert moved.bounds[0, 0] == bare_room.bounds[0, 0] + 1.0


def test_tiles_that_the_map_keeps_are_marked():
    grid = TileGrid(origin=np.zeros(3), size=np.ones(3), shape=(2, 2, 1), lowest=(0, 0, 0))
    kept = kept_tiles(grid, np.array([[0, 1, 0]], np.int32))
    assert kept[..., 0].tolist() == [[False, True], [False, False]]
