"""One room that is really walked, mapped, edited and surveyed; and that a visit comes back from disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.worker.benchmarks.revisit.conftest import SEED, TINY
from worker.benchmarks.revisit import visits
from worker.benchmarks.revisit.plan import CASES, plan_visits
from worker.benchmarks.revisit.visits import load_parts, load_site, make_visits
from worker.cloud import npz
from worker.cloud.voxel_keys import near
from worker.simulation.hits import Visit

PLANS = plan_visits(len(CASES), TINY, first_seed=SEED)


def site_of(folder: Path):
    return load_site(PLANS[0].site, folder / TINY.fingerprint)


def test_poses_come_from_registration_and_are_near_the_truth(walked, visits_folder):
    site = site_of(visits_folder)
    assert site.poses.accepted.tolist() == [True] * 3
    assert site.poses.metres.max() < 0.05
    for case, visit in walked.items():
        assert visit.poses.accepted.any()
        if case != "shifted":
            assert np.median(visit.poses.metres) < 0.03  # one may well be wrong: so few stops
            assert np.nanmedian(visit.misalignment) < 0.03


def test_a_shifted_survey_lies_off_by_what_it_was_pushed(walked):
    assert 0.008 < np.nanmedian(walked["shifted"].misalignment) < 0.06


def test_quiet_visits_have_no_true_change(walked):
    for case in ("unchanged", "people", "carrier"):
        assert not len(walked[case].truth.keys)
        assert not len(walked[case].truth.surface)


def test_what_changed_was_hit_by_the_visit_in_which_it_stands(walked, visits_folder):
    truth, site = walked["changed"].truth, site_of(visits_folder)
    assert truth.decidable.any()
    for side, seen in ((Visit.FIRST, site.seen), (Visit.SECOND, walked["changed"].seen)):
        keys = truth.decidable_keys(side)
        assert near(keys, seen.keys, 1).mean() > 0.9


def test_every_tile_that_either_visit_or_a_change_touched_is_listed(walked, visits_folder):
    site, visit = site_of(visits_folder), walked["changed"]
    grid = site.reference.grid
    for points in (site.reference.points, visit.points):
        tiles = np.unique(np.floor((points - grid.origin) / grid.size).astype(int), axis=0)
        listed = {tuple(tile) for tile in visit.tiles.tolist()}
        assert all(tuple(tile) in listed for tile in tiles.tolist())


def test_a_single_scan_sees_less_than_a_whole_visit(walked):
    assert len(walked["single"].poses.accepted) == 1
    assert len(walked["single"].seen.keys) < len(walked["unchanged"].seen.keys)


def test_sights_have_a_range_image_of_each_scan_whose_sensor_is_known(walked):
    for case, visit in walked.items():
        known = np.isfinite(visit.poses.origins).all(axis=1)
        assert visit.seen.sights is not None
        assert len(visit.seen.sights) == known.sum()
        # who walks close by is smeared over what is behind, so that no single place could have seen both
        assert known.all() or case == "people"


def test_the_maps_own_scans_are_kept_in_parts_that_make_the_map(visits_folder: Path):
    parts = load_parts(PLANS[0].site, visits_folder / TINY.fingerprint)
    assert len(parts) == 3
    together = np.unique(np.concatenate([part.keys for part in parts]))
    assert np.array_equal(together, site_of(visits_folder).seen.keys)


def test_visits_that_are_there_are_not_made_again(visits_folder: Path):
    _, made = make_visits(PLANS, TINY, visits_folder)
    assert made == 0


def test_a_visit_that_was_lost_is_made_again_the_same_on_the_map_that_is_kept(
    visits_folder: Path, walked, tmp_path: Path
):
    place = tmp_path / TINY.fingerprint
    place.mkdir()
    for name in (PLANS[0].site.name, PLANS[1].name):
        source = visits.path_of(name, visits_folder / TINY.fingerprint)
        visits.path_of(name, place).write_bytes(source.read_bytes())
    _, made = make_visits(PLANS[1:3], TINY, tmp_path)
    assert made == 1
    again = npz.load(visits.path_of(PLANS[2].name, place), visits.Revisit)
    before = walked[PLANS[2].case]
    assert np.array_equal(again.seen.keys, before.seen.keys)
    assert np.array_equal(again.misalignment, before.misalignment, equal_nan=True)


def test_a_visit_comes_back_from_disk(made_visit, upright, tmp_path: Path):
    changes = [(upright(0, 50), "add", Visit.SECOND, True)]
    visit = made_visit(PLANS[0].name, tiles=2, changes=changes, misalignment=[0.01, np.nan])
    npz.save(visits.path_of(visit.name, tmp_path), visit)
    (again,) = visits.load_visits(PLANS[:1], tmp_path)
    assert again.name == visit.name
    assert again.seen.sights is None
    assert again.truth.things == visit.truth.things
    for name in ("tiles", "points", "misalignment", "sigma"):
        assert np.array_equal(getattr(again, name), getattr(visit, name), equal_nan=True)
    for name in ("keys", "visit", "object_ids", "decidable", "surface"):
        assert np.array_equal(getattr(again.truth, name), getattr(visit.truth, name))


def test_a_visit_without_changes_comes_back_too(made_visit, tmp_path: Path):
    visit = made_visit(PLANS[0].name, tiles=1)
    npz.save(visits.path_of(visit.name, tmp_path), visit)
    assert visits.load_visits(PLANS[:1], tmp_path)[0].truth.things == ()
