"""Which tiles count, and as what, for changes that are put in."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.tiles import NOTHING, binned, tile_table
from worker.cloud.voxel_keys import packed
from worker.simulation.hits import Visit
from worker.simulation.truth import KINDS

ROOM = RevisitSettings(kinds=("room",))


@pytest.fixture
def table_of(made_visit, made_site):
    """The table of one changed visit to tiles in a row."""

    def of(changes, tiles=4, min_points=1):
        (plan,) = plan_visits(1, ROOM, first_seed=1)
        site = made_site(plan.site.name, tiles=tiles, gone=[part[0] for part in changes if part[2] == 0])
        visit = made_visit(plan.name, tiles=tiles, changes=changes)
        return tile_table([plan], [visit], {site.name: site}, min_points=min_points)

    return of


def test_a_tile_is_changed_from_forty_decidable_voxels_and_left_out_below(table_of, upright):
    table = table_of(
        [
            (upright(0, 40), "add", Visit.SECOND, True),
            (upright(1, 39), "add", Visit.SECOND, True),
            (upright(2, 60), "add", Visit.SECOND, False),
        ]
    )
    assert table.changed.tolist() == [True, False, False, False]
    assert table.counted.tolist() == [True, False, False, True]
    assert [table.kind[0], table.kind[3]] == [KINDS.index("add"), NOTHING]


def test_voxels_of_both_visits_and_of_all_kinds_count_together(table_of, upright):
    table = table_of(
        [
            (upright(0, 25), "remove", Visit.FIRST, True),
            (upright(0, 60)[40:], "move", Visit.SECOND, True),
        ]
    )
    assert table.cells[0].tolist() == [0, 25, 20]
    assert table.changed[0]
    assert KINDS[table.kind[0]] == "remove"


def test_a_tile_beside_a_change_by_less_than_a_voxel_is_left_out(table_of):
    rows = np.arange(50)
    at_the_border = packed(np.stack([np.full(50, 29), rows % 10, 2 + rows // 10], axis=1))
    table = table_of([(np.sort(at_the_border), "add", Visit.SECOND, True)])
    assert table.changed.tolist() == [True, False, False, False]
    assert table.counted.tolist() == [True, False, True, True]


def test_a_changed_tile_without_a_score_is_a_miss(table_of, upright):
    table = table_of([(upright(tile, 50), "add", Visit.SECOND, True) for tile in (0, 1)])
    counts = table.count(np.array([0.9, np.nan, 0.9, 0.1]), 0.5)
    assert (counts.true_positives, counts.false_negatives) == (1, 1)
    assert (counts.false_positives, counts.true_negatives) == (1, 1)


def test_tiles_where_the_map_is_thin_count_like_all_others(table_of, upright):
    table = table_of([(upright(0, 50), "remove", Visit.FIRST, True)], min_points=30)
    assert table.dense.tolist() == [True, False, False, False]
    assert table.counted.all()
    assert table.groups()["tile"]["thin in the map"].tolist() == [False, True, True, True]


def test_coverage_is_of_the_survey_for_each_point_of_the_map(table_of, upright):
    table = table_of(
        [(upright(0, 20), "remove", Visit.FIRST, True), (upright(1, 20), "add", Visit.SECOND, True)]
    )
    assert table.coverage.tolist() == [0.5, 2.0, 1.0, 1.0]


def test_tiles_stand_visit_after_visit_with_their_case(made_visit, made_site):
    plans = plan_visits(3, ROOM, first_seed=1)
    visits = [made_visit(plan.name, tiles=2) for plan in plans]
    site = made_site(plans[0].site.name, tiles=2)
    table = tile_table(plans, visits, {site.name: site}, min_points=1)
    assert table.visit.tolist() == [0, 0, 1, 1, 2, 2]
    assert table.case.tolist() == ["changed"] * 2 + ["sparse"] * 2 + ["unchanged"] * 2
    assert table.quiet.tolist() == [False] * 4 + [True] * 2
    for by in ("case", "building", "tile", "coverage"):
        assert np.sum([*table.groups()[by].values()], axis=0).tolist() == [1] * 6


def test_a_bin_holds_its_lower_edge_and_what_is_not_known_lies_in_none():
    values = np.array([0.0, 0.0025, 0.005, 0.5, np.inf, np.nan])
    bins = binned(values, (0.0, 0.0025, 0.01, np.inf), "{:g} cm", scale=100)
    assert {name: np.flatnonzero(tiles).tolist() for name, tiles in bins.items()} == {
        "0 to 0.25 cm": [0],
        "0.25 to 1 cm": [1, 2],
        "over 1 cm": [3, 4],
    }
