"""What each case does to the building, and where its robot stands."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.revisit.plan import CASES, Case, RevisitSettings, SitePlan, VisitPlan
from worker.benchmarks.revisit.walks import carrier_of, push_of, walk
from worker.simulation.hits import edited_things
from worker.simulation.truth import KINDS

SETTINGS = RevisitSettings()
SITE = SitePlan(kind="room", seed=3, cluttered=True)


def plan_of(case: Case) -> VisitPlan:
    return VisitPlan(site=SITE, case=case)


@pytest.fixture(scope="module")
def before():
    return SITE.scene(SETTINGS)


def test_quiet_visits_find_the_very_same_scene(before):
    for case in ("unchanged", "people", "carrier"):
        after, poses = walk(plan_of(case), before, SETTINGS)
        assert edited_things(before, after) == ()
        assert len(poses) == 6


def test_a_robot_that_passes_once_takes_the_first_half_of_its_stops(before):
    assert len(walk(plan_of("once"), before, SETTINGS)[1]) == 3
    assert len(walk(plan_of("sparse"), before, SETTINGS)[1]) == 2


def test_a_single_scan_looks_at_edited_things(before):
    after, (pose,) = walk(plan_of("single"), before, SETTINGS)
    edited = {thing.object_id for thing in edited_things(before, after)}
    middles = [
        item.mesh.bounds.mean(axis=0)
        for item in (*before.objects, *after.objects)
        if item.object_id in edited
    ]
    assert any((middle - pose[:3, 3]) @ pose[:3, 0] > 0 for middle in middles)


@pytest.mark.parametrize(
    ("case", "prefixes", "kinds"),
    [
        ("small", ("small-", "new-small-"), {"add", "remove"}),
        ("sheets", ("sheet-", "new-sheet-"), {"add", "remove"}),
        ("nudged", ("",), {"move"}),
    ],
)
def test_hard_cases_edit_what_their_name_says(before, case, prefixes, kinds):
    after, _ = walk(plan_of(case), before, SETTINGS)
    things = edited_things(before, after)
    assert {KINDS[thing.kind] for thing in things} == kinds
    names = {item.object_id: item.name for item in (*before.objects, *after.objects)}
    assert all(names[thing.object_id].startswith(prefixes) for thing in things)


def test_a_shifted_survey_is_pushed_off_by_one_to_five_centimetres():
    pushes = [
        push_of(VisitPlan(site=SitePlan(kind="room", seed=seed), case="shifted"), SETTINGS)
        for seed in range(20)
    ]
    lengths = [float(np.linalg.norm(push[:3, 3])) for push in pushes]
    assert min(lengths) >= 0.01 and max(lengths) <= 0.05
    assert max(lengths) - min(lengths) > 0.02
    assert all(np.array_equal(push[:3, :3], np.eye(3)) for push in pushes)
    others = [push_of(plan_of(case), SETTINGS) for case in CASES if case != "shifted"]
    assert all(np.array_equal(push, np.eye(4)) for push in others)


def test_only_the_carrier_case_sees_its_robot():
    assert [case for case in CASES if carrier_of(plan_of(case)) is not None] == ["carrier"]
