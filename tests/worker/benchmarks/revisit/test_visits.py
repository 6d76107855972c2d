"""One room that is really walked, mapped, edited and surveyed; which tiles count; and that a visit comes back from disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from worker.benchmarks.revisit import visits
from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.visits import make_visits
from worker.cloud import npz


def test_poses_come_from_registration_and_are_near_the_truth(walked):
    for visit in walked.values():
        assert visit.first.accepted == visit.first.scans == 3
        assert visit.second.accepted > 0
        assert np.nanmedian(visit.misalignment) < 0.03
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


def test_a_tile_is_changed_from_forty_cells_of_all_kinds_together(made_visit):
    visit = made_visit(cells=[[39, 0, 0], [20, 0, 20], [0, 0, 0]])
    assert visit.exists.tolist() == [False, True, False]
    assert visit.kinds.tolist() == [visits.NOTHING, 0, visits.NOTHING]


def test_the_kind_is_that_of_most_cells(made_visit):
    assert made_visit(cells=[[30, 50, 40]]).kinds.tolist() == [1]


def test_a_change_out_of_sight_counts_neither_way_and_neither_does_an_unobserved_tile(made_visit):
    visit = made_visit(
        cells=[[50, 0, 0], [50, 0, 0], [50, 0, 0], [0, 0, 0]],
        in_sight=[[50, 0, 0], [10, 0, 0], [50, 0, 0], [0, 0, 0]],
        observed=[True, True, False, True],
    )
    assert visit.changed.tolist() == [True, False, True, False]
    assert visit.counted.tolist() == [True, False, False, True]


def test_a_visit_comes_back_from_disk(made_visit, tmp_path: Path):
    visit = made_visit(cells=[[50, 0, 0], [0, 7, 0]], misalignment=[0.01, np.nan], outside=3)
    (plan,) = plan_visits(1, RevisitSettings(kinds=("room",)), first_seed=1)
    npz.save(visits.path_of(visit.name, tmp_path), visit)
    (again,) = visits.load_visits([plan], tmp_path)
    assert again.name == visit.name
    assert again.outside == 3
    assert (again.second.scans, again.second.accepted) == (2, 1)
    for name in ("cells", "in_sight", "misalignment", "sigma"):
        assert np.array_equal(getattr(again, name), getattr(visit, name), equal_nan=True)
    assert [part.tolist() for part in again.pairs.current] == [part.tolist() for part in visit.pairs.current]
    assert again.pairs.reference.indices.tolist() == visit.pairs.reference.indices.tolist()
