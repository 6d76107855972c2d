"""Objects found and made up, counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from worker.benchmarks.revisit.answers import PredictedObject, VisitAnswer
from worker.benchmarks.revisit.plan import RevisitSettings, plan_visits
from worker.benchmarks.revisit.things import HARD_MIN_VOXELS, object_figures, things_of
from worker.cloud.voxel_keys import packed, unpacked
from worker.simulation.hits import Visit

NONE = np.empty(0, np.int64)


def told(before=NONE, now=NONE, kind: str | None = None) -> PredictedObject:
    kinds = {(True, False): "disappeared", (False, True): "appeared", (True, True): "moved"}
    return PredictedObject(
        kind=kind or kinds[len(before) > 0, len(now) > 0],
        before=np.sort(before),
        now=np.sort(now),
        probability=0.9,
    )


def shifted(keys, x=0, y=0, z=0):
    return packed(unpacked(keys) + np.array([x, y, z]))


@pytest.fixture
def figures(made_visit):
    """What is found where some objects are told in one visit with some changes, and others in a quiet one."""

    def of(changes, objects, quiet_objects=()):
        plans = [plan_visits(3, RevisitSettings(kinds=("room",)), first_seed=1)[number] for number in (0, 2)]
        visits = [
            made_visit(plans[0].name, tiles=4, changes=changes),
            made_visit(plans[1].name, tiles=4),
        ]
        answers = [
            VisitAnswer(scores=np.zeros(4), objects=tuple(them), reliability=None)
            for them in (objects, quiet_objects)
        ]
        things = things_of(plans, visits)
        return object_figures(things, visits, answers), things

    return of


def test_a_region_is_found_if_one_object_covers_a_quarter_of_it(figures, upright):
    come = (upright(0, 80), "add", Visit.SECOND, True)
    # an upper row of the plate and what touches it: of 80 voxels 20 lie within a voxel of one row
    assert figures([come], [told(now=upright(0, 80)[::8][:10])])[0].found.tolist() == [True]
    row = packed(np.stack([np.full(10, 15), 10 + np.arange(10), np.full(10, 2 - 1)], axis=1))
    assert figures([come], [told(now=row)])[0].found.tolist() == [False]  # touches one row of ten: an eighth
    assert figures([come], [])[0].found.tolist() == [False]


def test_an_object_off_by_one_voxel_is_found_and_by_two_is_not(figures, upright):
    come = (upright(0, 80), "add", Visit.SECOND, True)
    for voxels, found in ((1, True), (2, False)):
        assert figures([come], [told(now=shifted(upright(0, 80), x=voxels))])[0].found.tolist() == [found]


def test_an_object_of_the_wrong_visit_finds_nothing(figures, upright):
    come = (upright(0, 80), "add", Visit.SECOND, True)
    result, _ = figures([come], [told(before=upright(0, 80))])
    assert result.found.tolist() == [False]
    assert result.true.tolist() == [True]  # something did change there


def test_regions_of_fewer_than_forty_decidable_voxels_are_nobodys_to_find(figures, upright):
    changes = [
        (upright(0, 39), "add", Visit.SECOND, True),
        (upright(1, 90), "add", Visit.SECOND, False),
        (upright(2, 40), "remove", Visit.FIRST, True),
    ]
    _, things = figures(changes, [])
    assert [(region.kind, len(region.keys)) for region in things.regions] == [("remove", 40)]
    assert list(things.groups()["kind"]) == ["remove, gone"]


def test_in_the_hard_part_smaller_ones_are_to_be_found(made_visit, upright):
    (plan,) = plan_visits(1, RevisitSettings(kinds=("room",)), first_seed=1)
    changes = [(upright(tile, count), "add", Visit.SECOND, True) for tile, count in enumerate((11, 12, 39))]
    visit = made_visit(plan.name, tiles=4, changes=changes)
    things = things_of([plan], [visit], min_voxels=HARD_MIN_VOXELS)
    assert [len(region.keys) for region in things.regions] == [12, 39]
    told_of = [told(now=upright(3, count)) for count in (11, 12)]
    answer = VisitAnswer(scores=np.zeros(4), objects=tuple(told_of), reliability=None)
    figures = object_figures(things, [visit], [answer])
    assert figures is not None
    assert len(figures.true) == 1


def test_an_object_is_true_if_half_of_it_lies_within_two_voxels_of_a_change_decidable_or_not(
    figures, upright
):
    come = (upright(0, 80), "add", Visit.SECOND, False)
    near, far = shifted(upright(0, 80), x=2), shifted(upright(0, 80), x=3)
    half = np.r_[near[:40], shifted(upright(2, 80), z=3)[:40]]
    assert figures([come], [told(now=keys) for keys in (near, far, half)])[0].true.tolist() == [
        True,
        False,
        True,
    ]


def test_small_objects_are_no_false_ones_but_an_alarm_to_the_user(figures, upright):
    result, things = figures([], [], [told(now=upright(3, 39)), told(now=upright(1, 50))])
    document = result.document(things)
    assert (document["objects"], document["false_objects"]) == (1, 1)
    assert document["false_objects_a_quiet_visit"] == 1.0
    assert (document["quiet_visits"], document["quiet_visits_with_an_object"]) == (1, 1)
    assert result.any_size.tolist() == [0, 2]
    assert document["recall"] is None


def test_a_thing_that_moved_is_told_as_moved_by_one_object_with_both_places(figures, upright):
    moved = [(upright(0, 80), "move", Visit.FIRST, True), (upright(2, 80), "move", Visit.SECOND, True)]
    one = told(before=upright(0, 80), now=upright(2, 80))
    two = [told(before=upright(0, 80)), told(now=upright(2, 80))]
    for objects, as_moved in (([one], [True]), (two, [False])):
        result, things = figures(moved, objects)
        assert things.moved == ((0, 1),)
        assert result.found.tolist() == [True, True]
        assert result.told_moved.tolist() == as_moved
