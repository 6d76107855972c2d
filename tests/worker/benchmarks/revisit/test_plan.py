"""Which buildings are visited, and that none of them is one that was trained on."""

from __future__ import annotations

from collections import Counter

import pytest

from worker.benchmarks.revisit.plan import (
    ALL_CASES,
    CASES,
    HARD_CASES,
    HARD_SEED,
    TEST_SEED,
    VALIDATION_SEED,
    RevisitSettings,
    SitePlan,
    VisitPlan,
    kinds_named,
    plan_hard_visits,
    plan_visits,
)
from worker.simulation.scenes.subtle import SMALL
from worker.simulation.training_set import TrainingSetSettings

SETTINGS = RevisitSettings()


def test_every_building_is_visited_in_every_case_and_all_kinds_take_turns():
    plans = plan_visits(48, SETTINGS, first_seed=TEST_SEED)
    assert Counter(plan.case for plan in plans) == dict.fromkeys(CASES, 6)
    assert Counter(plan.site.kind for plan in plans) == {"room": 16, "office": 16, "corridor": 8, "loop": 8}
    assert len({plan.site for plan in plans}) == 6
    assert len({plan.name for plan in plans}) == 48


def test_more_than_a_third_of_the_visits_are_quiet():
    plans = plan_visits(48, SETTINGS, first_seed=TEST_SEED)
    assert sum(plan.quiet for plan in plans) == 18
    assert {plan.case for plan in plans if plan.quiet} == {"unchanged", "people", "carrier"}


def test_a_count_that_eight_does_not_divide_leaves_the_last_building_with_fewer_cases():
    assert [plan.case for plan in plan_visits(9, SETTINGS, first_seed=5)][-1] == "changed"


def test_no_two_visits_share_a_seed_nor_a_building_with_training_or_validation():
    training = TrainingSetSettings()
    trained = {training.seed + n for n in range(training.offices + training.corridors + training.rooms)}
    test, validation = (plan_visits(200, SETTINGS, first_seed=s) for s in (TEST_SEED, VALIDATION_SEED))
    hard = plan_hard_visits(SETTINGS)
    buildings = [{plan.site.seed for plan in plans} for plans in (test, validation, hard)]
    together = set.union(*buildings)
    assert len(together) == sum(map(len, buildings))
    assert not together & trained
    assert not any(2_000_000 <= seed < 2_010_000 for seed in together)  # training of the voxel network
    seeds = [plan.seed for plan in (*test, *validation, *hard)]
    firsts = [20 * seed for seed in together]
    assert len({*seeds, *firsts}) == len(seeds) + len(firsts)


def test_the_hard_part_has_all_its_cases_and_glass_in_buildings_of_their_own():
    plans = plan_hard_visits(SETTINGS)
    assert {plan.case for plan in plans} == set(HARD_CASES)
    assert all(plan.hard for plan in plans)
    assert all(plan.site.glazed == plan.case.startswith("glass") for plan in plans)
    assert plans[0].site.seed == HARD_SEED
    rooms = plan_hard_visits(RevisitSettings(kinds=("room",)))
    assert {plan.site.kind for plan in rooms} == {"room"}
    assert {plan.site for plan in rooms} < {plan.site for plan in plans}


def test_a_cluttered_building_has_small_things_and_sheets_and_a_glazed_one_shines():
    cluttered = SitePlan(kind="office", seed=3, cluttered=True).scene(SETTINGS)
    names = Counter(item.name.split("-")[0] for item in cluttered.movable)
    assert names["small"] >= 5
    assert names["sheet"] >= 3
    small = [item for item in cluttered.movable if item.name.startswith("small-")]
    assert all((item.mesh.bounds[1] - item.mesh.bounds[0]).max() < 1.5 * SMALL[1] for item in small)
    glazed = SitePlan(kind="office", seed=3, glazed=True).scene(SETTINGS)
    assert {item.surface for item in glazed.objects} == {"matt", "glass", "mirror"}


def test_visits_made_in_another_way_are_kept_apart_and_the_choice_of_buildings_is_no_such_way():
    assert RevisitSettings(standing_s=4).fingerprint != SETTINGS.fingerprint
    assert RevisitSettings(kinds=("room",)).fingerprint == SETTINGS.fingerprint


def test_stops_edits_and_people_of_each_case():
    plans = {case: VisitPlan(site=SitePlan(kind="office", seed=5), case=case) for case in ALL_CASES}
    assert {plan.stops(SETTINGS) for case, plan in plans.items() if case != "sparse"} == {14}
    assert plans["sparse"].stops(SETTINGS) == 5
    edits = {case: plan.edits(SETTINGS) for case, plan in plans.items()}
    assert {case for case, count in edits.items() if not count} == {
        "unchanged",
        "people",
        "carrier",
        "glass-quiet",
    }
    assert edits["single"] == 12
    assert {count for case, count in edits.items() if count and case != "single"} == {6}
    people = {case: plan.people(SETTINGS) for case, plan in plans.items() if plan.people(SETTINGS)}
    assert people == {"people": 2, "crowd": 4}
    assert len({plan.seed for plan in plans.values()}) == len(plans)


def test_buildings_are_named_with_commas():
    assert kinds_named("loop, room") == ("loop", "room")
    with pytest.raises(ValueError, match="no building attic"):
        kinds_named("room,attic")
