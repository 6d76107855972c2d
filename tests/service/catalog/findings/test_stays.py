"""How long a change of a tile stays: told once while it does, and again when it comes back."""

from __future__ import annotations

import itertools
from datetime import timedelta

import pytest

from service.catalog.findings.stays import Known, Look, Stay, heir, recognized, stays
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


# which change goes on as which


def known(change: str, told_by: int, *days: int) -> Known:
    """A change that the survey of `told_by` stood for, and the surveys of some days saw."""
    return Known(
        change_id=change,
        told_by=f"survey-{told_by}",
        survey_ids=frozenset(f"survey-{day}" for day in days),
    )


def names(found: list[Stay], *before: Known) -> dict[int, str]:
    return {n: one.change_id for n, one in recognized(found, before).items()}


def test_a_change_goes_on_as_the_stay_that_has_the_visit_which_stood_for_it() -> None:
    found = stays([look(1, 0.6), look(2, 0.6), look(3, None), look(4, 0.6)])
    assert names(found, known("a", 4, 1, 2, 4)) == {1: "a"}


def test_where_that_visit_is_gone_it_goes_on_as_the_one_that_shares_most() -> None:
    found = stays([look(1, 0.6), look(2, None), look(3, 0.6), look(4, 0.6)])
    assert names(found, known("a", 9, 1, 3, 4)) == {1: "a"}


def test_of_two_that_are_one_the_older_goes_on_and_the_other_has_an_heir() -> None:
    found = stays([look(1, 0.6), look(3, 0.6)])
    newer = known("newer", 1, 1)
    assert names(found, known("older", 3, 3), newer) == {0: "older"}
    assert heir(found, newer) == 0


def test_a_change_of_which_no_visit_is_left_goes_on_as_none() -> None:
    found = stays([look(5, 0.6)])
    assert names(found, known("a", 1, 1, 2)) == {}
    assert heir(found, known("a", 1, 1, 2)) is None
