"""Which buildings are visited, and that none of them is one that was trained on."""

from __future__ import annotations

from collections import Counter

import pytest

from worker.benchmarks.revisit.plan import (
    CASES,
    TEST_SEED,
    VALIDATION_SEED,
    RevisitSettings,
    SitePlan,
    VisitPlan,
    kinds_named,
    plan_visits,
)
from worker.simulation.training_set import TrainingSetSettings

SETTINGS = RevisitSettings()


def test_every_building_is_visited_in_every_case_and_all_kinds_take_turns():
    plans = plan_visits(24, SETTINGS, first_seed=TEST_SEED)
    assert Counter(plan.case for plan in plans) == {"changed": 8, "sparse": 8, "unchanged": 8}
    assert Counter(plan.site.kind for plan in plans) == {"room": 6, "office": 6, "corridor": 6, "loop": 6}
    assert len({plan.site for plan in plans}) == 8
    assert len({plan.name for plan in plans}) == 24


def test_a_count_that_three_does_not_divide_leaves_the_last_building_with_fewer_cases():
    assert [plan.case for plan in plan_visits(4, SETTINGS, first_seed=5)][-1] == "changed"


def test_no_two_visits_share_a_seed_nor_a_building_with_training_or_validation():
    training = TrainingSetSettings()
    trained = {training.seed + n for n in range(training.offices + training.corridors + training.rooms)}
    test, validation = (plan_visits(60, SETTINGS, first_seed=s) for s in (TEST_SEED, VALIDATION_SEED))
    buildings = [{plan.site.seed for plan in plans} for plans in (test, validation)]
    assert not buildings[0] & buildings[1]
    assert not (buildings[0] | buildings[1]) & trained
    seeds = [plan.seed for plan in (*test, *validation)]
    firsts = [10 * seed for seed in buildings[0] | buildings[1]]
    assert len({*seeds, *firsts}) == len(seeds) + len(firsts)


def test_visits_made_in_another_way_are_kept_apart_and_the_choice_of_buildings_is_no_such_way():
    assert RevisitSettings(standing_s=4).fingerprint != SETTINGS.fingerprint
    assert RevisitSettings(kinds=("room",)).fingerprint == SETTINGS.fingerprint


def test_a_third_of_the_stops_and_no_edit_where_the_case_says_so():
    plans = {case: VisitPlan(site=SitePlan(kind="office", seed=5), case=case) for case in CASES}
    assert {case: plan.stops(SETTINGS) for case, plan in plans.items()} == {
        "changed": 14,
        "sparse": 5,
        "unchanged": 14,
    }
    assert {case: plan.edits(SETTINGS) for case, plan in plans.items()} == {
        "changed": 6,
        "sparse": 6,
        "unchanged": 0,
    }
    assert plans["changed"].seed != plans["sparse"].seed  # of the edits too


def test_buildings_are_named_with_commas():
    assert kinds_named("loop, room") == ("loop", "room")
    with pytest.raises(ValueError, match="no building attic"):
        kinds_named("room,attic")
