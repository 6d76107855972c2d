"""Tiles of several visits side by side, and figures of scores that are put in by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from worker.benchmarks.methods import Method
from worker.benchmarks.revisit.measures import (
    VisitScores,
    binned,
    measure,
    score_visits,
    threshold_of,
    tile_table,
)
from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits

ADD, NONE = [50, 0, 0], [0, 0, 0]


@pytest.fixture
def table(made_visit):
    """A changed visit with four changed tiles, one of them unobserved, and one that is not; two visits of two quiet tiles."""
    planned = plan_visits(6, RevisitSettings(kinds=("room",)), first_seed=1)
    plans = [planned[0], planned[2], planned[5]]
    visits = [
        made_visit(
            plans[0].name,
            cells=[ADD, [0, 50, 0], ADD, ADD, [30, 0, 0]],
            observed=[True, True, True, False, True],
            misalignment=[0.001, 0.001, 0.03, 0.03, 0.001],
        ),
        made_visit(plans[1].name, cells=[NONE, NONE]),
        made_visit(plans[2].name, cells=[NONE, NONE]),
    ]
    return tile_table(plans, visits)


def scored(*visits):
    return VisitScores(scores=np.concatenate([np.array(scores) for scores in visits]), seconds=2.0)


SCORES = scored([0.9, 0.8, 0.2, np.nan, 0.7], [0.1, 0.3], [0.1, 0.6])


def test_counts_at_a_threshold_and_at_the_best_one(table):
    found = measure("m", SCORES, table, threshold=0.5, stated=0.75)
    counts = found.chosen.counts
    assert (counts.true_positives, counts.false_negatives) == (2, 1)
    assert (counts.false_positives, counts.true_negatives) == (2, 3)
    assert (counts.unobserved, counts.unobserved_changed) == (1, 1)
    assert found.best.threshold == pytest.approx(0.75)
    assert found.best.counts.f1 == pytest.approx(0.8)
    assert found.best.counts.unobserved_changed == 1
    assert found.stated is not None
    assert found.stated.counts == found.best.counts


def test_false_alarms_are_told_apart(table):
    found = measure("m", SCORES, table, threshold=0.5)
    assert found.alarms_on_slight == 1
    assert (found.unchanged_visits, found.unchanged_visits_with_alarm) == (2, 1)


def test_recall_by_kind_of_change_and_by_misalignment(table):
    groups = measure("m", SCORES, table, threshold=0.5).groups
    assert {kind: (c.true_positives, c.changed) for kind, c in groups["kind"].items()} == {
        "add": (1, 2),
        "remove": (1, 1),
        "move": (0, 0),
    }
    assert groups["misfit"]["over 2 cm"].recall == 0
    assert groups["misfit"]["0 to 0.25 cm"].recall == 1
    assert groups["case"]["unchanged"].changed == 0


def test_the_threshold_is_the_best_cut_of_the_tiles_that_count(table):
    assert threshold_of(SCORES, table) == pytest.approx(0.75)


def test_visits_without_any_change_have_no_best_threshold(made_visit):
    plans = plan_visits(1, RevisitSettings(), first_seed=1)
    quiet = tile_table(plans, [made_visit(cells=[NONE, NONE])])
    with pytest.raises(ValueError, match="no tile changed"):
        threshold_of(scored([0.1, 0.2]), quiet)


def test_the_interval_holds_the_figure_and_a_perfect_method_has_none_but_one(table):
    low, high = measure("m", SCORES, table, threshold=0.5).f1_interval
    assert low <= 2 * 2 / (2 * 2 + 2 + 1) <= high
    perfect = scored([1, 1, 1, np.nan, 0], [0, 0], [0, 0])
    assert measure("m", perfect, table, threshold=0.5).f1_interval == (1.0, 1.0)


def test_a_document_is_json_and_says_none_where_a_figure_has_no_meaning(table):
    document = measure("m", SCORES, table, threshold=0.5).document()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["groups"]["kind"]["move"]["recall"] is None
    assert document["stated"] is None


def test_every_visit_is_scored_by_itself(made_visit):
    visits = [made_visit(cells=[ADD, NONE]), made_visit(cells=[NONE])]
    counted = Method(name="n", score=lambda pairs: np.full(len(pairs.current), len(pairs.current), float))
    assert score_visits(counted, visits).scores.tolist() == [2, 2, 1]


@pytest.fixture
def office(made_visit):
    plans = plan_visits(3, RevisitSettings(kinds=("office",)), first_seed=1)
    visits = [
        made_visit(
            plans[0].name, cells=[[50, 0, 0], [0, 0, 60], [5, 0, 0]], misalignment=[0.0, 0.01, np.nan]
        ),
        made_visit(plans[1].name, cells=[[0, 80, 0]], observed=[False]),
        made_visit(plans[2].name, cells=[[0, 0, 0]], misalignment=[0.3]),
    ]
    return tile_table(plans, visits)


def test_tiles_stand_visit_after_visit(office):
    assert office.visit.tolist() == [0, 0, 0, 1, 2]
    assert office.case.tolist() == ["changed"] * 3 + ["sparse", "unchanged"]
    assert office.changed.tolist() == [True, True, False, True, False]
    assert office.counted.tolist() == [True, True, True, False, True]
    assert office.slight.tolist() == [False, False, True, False, False]


def test_groups_by_kind_hold_changed_tiles_only(office):
    kinds = {name: np.flatnonzero(tiles).tolist() for name, tiles in office.groups()["kind"].items()}
    assert kinds == {"add": [0], "remove": [3], "move": [1]}


def test_groups_by_case_and_building_hold_every_tile_once(office):
    for by in ("case", "building"):
        assert sum(tiles.astype(int) for tiles in office.groups()[by].values()).tolist() == [1] * 5


def test_a_bin_holds_its_lower_edge_and_what_is_not_known_lies_in_none():
    bins = binned(np.array([0.0, 0.0025, 0.00499, 0.01, 0.5, np.nan]))
    assert {name: np.flatnonzero(tiles).tolist() for name, tiles in bins.items()} == {
        "0 to 0.25 cm": [0],
        "0.25 to 0.5 cm": [1, 2],
        "0.5 to 1 cm": [],
        "1 to 2 cm": [3],
        "over 2 cm": [4],
    }
