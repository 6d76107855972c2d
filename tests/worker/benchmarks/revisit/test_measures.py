"""Figures of scores that are put in by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from worker.benchmarks.revisit.answers import Answers, PredictedObject, VisitAnswer
from worker.benchmarks.revisit.measures import measure, scores_of, threshold_of
from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.things import things_of
from worker.benchmarks.revisit.tiles import tile_table
from worker.simulation.hits import Visit


@pytest.fixture
def world(made_visit, made_site, upright):
    """A changed visit with four changed tiles and a quiet one, and two quiet visits of two tiles."""
    planned = plan_visits(11, RevisitSettings(kinds=("room",)), first_seed=1)
    plans = [planned[0], planned[2], planned[10]]
    changes = [
        (upright(tile, 50), kind, Visit.SECOND, True)
        for tile, kind in enumerate(("add", "remove", "add", "add"))
    ]
    visits = [
        made_visit(plans[0].name, tiles=5, changes=changes, misalignment=[0.001, 0.001, 0.03, 0.03, 0.001]),
        made_visit(plans[1].name, tiles=2),
        made_visit(plans[2].name, tiles=2),
    ]
    sites = {plan.site.name: made_site(plan.site.name, tiles=5) for plan in plans}
    return tile_table(plans, visits, sites, min_points=1), things_of(plans, visits), visits


def answers(*scores, objects=(None, None, None)):
    told = zip(scores, objects, strict=True)
    return Answers(
        visits=tuple(
            VisitAnswer(scores=np.array(score, float), objects=them, reliability=None) for score, them in told
        ),
        seconds=2.0,
    )


TOLD = answers([0.9, 0.8, 0.2, np.nan, 0.7], [0.1, 0.3], [0.1, 0.6])


def measured(world, told=TOLD, **options):
    table, things, visits = world
    return measure("m", told, table, things, visits, **{"threshold": 0.5, **options})


def test_counts_at_a_threshold_and_at_the_best_one_with_what_has_no_score_as_missed(world):
    found = measured(world, stated=0.75)
    counts = found.chosen.counts
    assert (counts.true_positives, counts.false_negatives) == (2, 2)
    assert (counts.false_positives, counts.true_negatives) == (2, 3)
    assert found.untold == 1
    assert found.best.threshold == pytest.approx(0.75)
    assert found.best.counts.f1 == pytest.approx(2 * 2 / (2 * 2 + 2))
    assert found.stated is not None
    assert found.stated.counts == found.best.counts


def test_average_precision_never_gets_the_tile_without_a_score(world):
    assert measured(world, answers([1, 1, 1, np.nan, 0], [0, 0], [0, 0])).average_precision == 0.75


def test_quiet_visits_are_alarmed_by_tiles_or_by_objects(world):
    thing = PredictedObject(
        kind="appeared", before=np.empty(0, np.int64), now=np.arange(5, dtype=np.int64), probability=0.9
    )
    told = answers([0.9, 0.8, 0.2, np.nan, 0.7], [0.1, 0.3], [0.1, 0.6], objects=((), (thing,), ()))
    found = measured(world, told)
    assert (found.quiet_visits, found.quiet_visits_with_tile, found.quiet_visits_alarmed) == (2, 1, 2)
    assert measured(world).quiet_visits_alarmed == 1


def test_recall_by_kind_of_change_and_by_misalignment(world):
    groups = measured(world).groups
    assert {kind: (c.true_positives, c.changed) for kind, c in groups["kind"].items()} == {
        "add": (1, 3),
        "remove": (1, 1),
        "move": (0, 0),
    }
    assert groups["misfit"]["2 to 4 cm"].recall == 0
    assert groups["misfit"]["0 to 0.25 cm"].recall == 1
    assert groups["case"]["unchanged"].changed == 0


def test_the_threshold_is_the_best_cut_of_the_tiles_that_count(world):
    assert threshold_of(scores_of(TOLD), world[0]) == pytest.approx(0.75)


def test_the_interval_holds_the_figure_and_a_perfect_method_has_none_but_one(world):
    low, high = measured(world).f1_interval
    assert low <= 2 * 2 / (2 * 2 + 2 + 2) <= high
    perfect = answers([1, 1, 1, 1, 0], [0, 0], [0, 0])
    assert measured(world, perfect).f1_interval == (1.0, 1.0)


def test_a_document_is_json_and_says_none_where_a_figure_has_no_meaning(world):
    document = measured(world, stated=0.5).document(world[1])
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["groups"]["kind"]["move"]["recall"] is None
    assert document["objects"] is None
    assert document["calibration"]["voxels"] is None
    assert sum(document["calibration"]["tiles"]["counts"]) == 8
