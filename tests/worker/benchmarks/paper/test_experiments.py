"""Changes go where they are sent, into the scan they are sent into; the rest of the current map is the reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.worker.benchmarks.paper.conftest import POINTS
from worker.benchmarks.paper.experiments import Experiment, experiments, inject, published, trials
from worker.benchmarks.paper.site import Site
from worker.cloud.types import Points
from worker.progress import no_progress
from worker.simulation.scenes import ChangeKind

ONE = Experiment(
    name="one", series="type", operation="remove", magnitude=0.15, density=0.35, scans=1, tiles_per_scan=1
)
NOTHING = replace(ONE, name="nothing", operation=None)


def rows(points: Points) -> set[bytes]:
    return {row.tobytes() for row in points}


def test_the_paper_has_fourteen_experiments_whose_counts_add_up_to_its_last_row() -> None:
    given, printed = experiments(), published()["table_5"]
    assert len(given) == 14
    assert [one.name for one in given] == list(printed)[:-1]
    for name in ("true_positives", "false_positives", "false_negatives", "true_negatives"):
        assert sum(printed[one.name][name] for one in given) == printed["aggregated"][name]
    for one in given:
        changed = printed[one.name]["true_positives"] + printed[one.name]["false_negatives"]
        assert changed <= one.scans * one.tiles_per_scan


@pytest.mark.parametrize(
    ("kind", "points"), [("remove", -0.35 * POINTS), ("add", 0.35 * POINTS), ("move", 0)]
)
def test_one_tile_of_one_scan_changes_by_its_share_of_points(
    site: Site, kind: ChangeKind, points: float
) -> None:
    found = inject(site, replace(ONE, operation=kind), 0)
    ((scan, after),) = found.scans.items()
    (tile,) = np.flatnonzero(found.truth)
    cell = site.tiles.grid.cells(site.tiles.indices[[tile]])[0]
    inside = site.tiles.grid.locate(after) == cell
    assert inside.sum() == POINTS + points
    untouched = site.scans[scan][site.tiles.grid.locate(site.scans[scan]) != cell]
    assert rows(after[~inside]) == rows(untouched)


def test_what_is_moved_to_the_border_stays_in_its_tile(site: Site) -> None:
    far = replace(ONE, operation="move", magnitude=5.0, density=0.5)
    found = inject(site, far, 0)
    ((scan, after),) = found.scans.items()
    before = np.unique(site.tiles.grid.locate(site.scans[scan]), return_counts=True)[1]
    assert np.unique(site.tiles.grid.locate(after), return_counts=True)[1].tolist() == before.tolist()


def test_everywhere_the_points_vanish_from_all_scans_that_saw_the_tile(site: Site) -> None:
    found = inject(site, ONE, 0, everywhere=True)
    (tile,) = np.flatnonzero(found.truth)
    cell = site.tiles.grid.cells(site.tiles.indices[[tile]])[0]
    seen = [scan for scan, places in enumerate(site.dense) if tile in places]
    assert sorted(found.scans) == seen
    left = sum(int((site.tiles.grid.locate(points) == cell).sum()) for points in found.scans.values())
    assert left == round(0.65 * POINTS * len(seen))


def test_the_same_number_makes_the_same_changes_and_another_one_others(site: Site) -> None:
    first, again, other = (inject(site, ONE, number) for number in (3, 3, 4))
    assert list(first.scans) == list(again.scans)
    assert all(np.array_equal(first.scans[scan], again.scans[scan]) for scan in first.scans)
    assert not all(
        np.array_equal(first.scans[scan], other.scans.get(scan, np.empty(0))) for scan in first.scans
    )


def test_no_change_modifies_nothing(site: Site) -> None:
    found = inject(site, replace(ONE, operation=None), 0)
    assert found.scans == {}
    assert not found.truth.any()


def test_scans_without_enough_dense_tiles_are_not_modified(site: Site) -> None:
    wide = replace(ONE, tiles_per_scan=3)
    assert all(2 not in inject(site, wide, number).scans for number in range(5))
    with pytest.raises(ValueError, match="3 scans with 3 dense tiles are needed, 2 have them"):
        inject(site, replace(wide, scans=3), 0)


def test_without_changes_the_current_map_is_the_reference_bit_for_bit(site: Site) -> None:
    (trial,) = trials(site, [NOTHING], no_progress)
    for before, now in zip(site.tiles.points, trial.pairs.current, strict=True):
        assert np.array_equal(before, now)


def test_a_change_in_one_tile_leaves_the_others_bit_for_bit(site: Site) -> None:
    (trial,) = trials(site, [ONE], no_progress)
    same = [np.array_equal(*both) for both in zip(site.tiles.points, trial.pairs.current, strict=True)]
    assert np.array_equal(~np.array(same), trial.truth)
    assert trial.truth.sum() == 1


def test_a_removal_everywhere_leaves_fewer_voxels_than_one_in_a_single_scan(site: Site) -> None:
    (alone,), (everywhere,) = (
        list(trials(site, [ONE], no_progress, everywhere=all_)) for all_ in (False, True)
    )
    assert len(everywhere.current) < len(alone.current) < len(site.points)


def test_with_what_was_seen_the_same_tiles_come_with_the_hits_and_range_images_of_all_scans(
    site: Site,
) -> None:
    nothing, removed = trials(site, [NOTHING, ONE], no_progress, seen=True)
    assert nothing.seen is not None
    assert removed.seen is not None
    (before, same), (also, after) = nothing.seen, removed.seen
    assert also is before
    assert removed.comparison.current.seen is after
    assert all(seen.sights is not None and len(seen.sights) == 3 for seen in (before, same, after))
    assert before.hits.sum() == sum(map(len, site.scans))
    assert before.hits.sum() - after.hits.sum() == 0.35 * POINTS
    assert np.array_equal(same.keys, before.keys)


def test_an_experiment_that_the_paper_has_not_is_refused() -> None:
    with pytest.raises(ValueError, match="no experiment fog; there are magnitude_5cm"):
        experiments(("fog", "type_add"))
    assert [experiment.name for experiment in experiments(("type_add",))] == ["type_add"]
