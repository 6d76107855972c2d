"""How long a change of a tile stays: told once while it does, and again when it comes back."""

from __future__ import annotations

import itertools
from datetime import timedelta

import pytest

from service.catalog.stays import Look, stays
from tests.support.samples import NOON


def look(day: int, score: float | None, *, version: int = 1) -> Look:
    """What the survey of a day says; a score where the tile is changed."""
    return Look(
        survey_id=f"survey-{day}", captured_at=NOON + timedelta(days=day), map_version=version, score=score
    )


def test_a_change_that_stays_is_one() -> None:
    (stay,) = stays([look(1, None), look(2, 0.6), look(3, 0.9), look(5, 0.7)])
    assert (stay.told_by, stay.survey_ids) == ("survey-2", ("survey-2", "survey-3", "survey-5"))
    assert (stay.first_seen, stay.last_seen) == (NOON + timedelta(days=2), NOON + timedelta(days=5))
    assert stay.max_score == 0.9


def test_a_change_that_is_gone_and_returns_is_told_again() -> None:
    found = stays([look(1, 0.6), look(2, None), look(3, 0.8), look(4, 0.7)])
    assert [(stay.told_by, stay.survey_ids) for stay in found] == [
        ("survey-1", ("survey-1",)),
        ("survey-3", ("survey-3", "survey-4")),
    ]


def test_the_order_of_the_looks_does_not_matter() -> None:
    looks = [look(1, 0.6), look(2, None), look(3, 0.8), look(4, 0.7)]
    for order in itertools.permutations(looks):
        assert stays(order) == stays(looks)


def test_a_late_visit_makes_a_change_older_and_leaves_it_told_by_the_same_survey() -> None:
    (stay,) = stays([look(1, 0.6), look(3, 0.8)], told_by={"survey-3"})
    assert (stay.told_by, stay.first_seen) == ("survey-3", NOON + timedelta(days=1))


def test_two_changes_that_become_one_are_told_by_the_earlier() -> None:
    (stay,) = stays([look(1, 0.6), look(3, 0.8)], told_by={"survey-1", "survey-3"})
    assert stay.told_by == "survey-1"


@pytest.mark.parametrize("between", [[], [look(2, None)]])
def test_a_change_against_a_map_that_took_the_tile_over_is_another(between: list[Look]) -> None:
    found = stays([look(1, 0.6), *between, look(3, 0.8, version=2)], accepted_in=[2])
    assert [stay.told_by for stay in found] == ["survey-1", "survey-3"]


def test_a_version_that_left_the_tile_alone_parts_nothing() -> None:
    (stay,) = stays([look(1, 0.6), look(3, 0.8, version=3)], accepted_in=[4])
    assert stay.survey_ids == ("survey-1", "survey-3")


def test_a_visit_compared_with_the_new_map_does_not_end_a_change_against_the_old_one() -> None:
    (stay,) = stays([look(1, 0.6), look(2, None, version=2), look(3, 0.8)], accepted_in=[2])
    assert stay.survey_ids == ("survey-1", "survey-3")


def test_a_tile_that_never_changed_has_no_stay() -> None:
    assert stays([look(1, None), look(2, None)]) == []
