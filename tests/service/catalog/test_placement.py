"""A survey whose placement is in doubt says nothing, and has no say in what became of tiles and objects."""

from __future__ import annotations

from datetime import timedelta

import pytest

from service.catalog.catalog import Catalog
from service.catalog.findings.changes import ChangeFilter
from service.catalog.findings.objects import ObjectFilter
from service.catalog.records import MapObjectRecord, ObjectRecord, Placement, TileRecord
from service.errors import Conflict
from tests.support.samples import NOON, add_map, add_survey, place, thing, tile

IN_DOUBT = Placement(state="in_doubt", confidence=0.71)
CONFIRMED = Placement(state="confirmed", confidence=0.99)
CRATE = thing(1, now=place(0.7, 0.7))


def visited(
    catalog: Catalog,
    tiles: list[TileRecord],
    *,
    day: int,
    placement: Placement = CONFIRMED,
    objects: list[ObjectRecord] | None = None,
) -> str:
    survey_id, job_id = add_survey(catalog, ready=False, captured_at=NOON + timedelta(days=day))
    scans = catalog.surveys.get(survey_id).scans
    accepted = [scan.model_copy(update={"accepted": True}) for scan in scans]
    catalog.surveys.save_outcomes(survey_id, accepted, placement=placement)
    catalog.surveys.save_result(survey_id, tiles=tiles, threshold=0.5, objects=objects)
    catalog.jobs.succeed(job_id)
    return survey_id


def the_object(catalog: Catalog) -> MapObjectRecord:
    (only,) = catalog.objects.page(ObjectFilter(map_id="lobby")).items
    return only


def seen(state: str) -> TileRecord:
    return tile(0, 0, state, observed_share=1.0)  # type: ignore[arg-type]


def test_the_placement_is_recorded_with_the_outcomes_and_not_before(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, ready=False)
    assert catalog.surveys.get(survey_id).placement is None
    catalog.surveys.save_outcomes(survey_id, [], placement=IN_DOUBT)
    assert catalog.surveys.get(survey_id).placement == IN_DOUBT
    assert catalog.surveys.page("lobby").items[0].placement == IN_DOUBT


@pytest.mark.parametrize(
    ("tiles", "objects"), [([seen("unchanged")], None), ([seen("changed")], None), ([], [CRATE])]
)
def test_a_survey_in_doubt_that_says_something_is_a_mistake(
    catalog: Catalog, tiles: list[TileRecord], objects: list[ObjectRecord] | None
) -> None:
    add_map(catalog)
    with pytest.raises(ValueError, match="in doubt"):
        visited(catalog, tiles, day=0, placement=IN_DOUBT, objects=objects)


def test_a_survey_in_doubt_is_in_no_change_and_ends_none(catalog: Catalog) -> None:
    """Changed on the first day, looked at in doubt on the second, changed on the third: one change of three days."""
    add_map(catalog)
    first = visited(catalog, [seen("changed")], day=0, objects=[CRATE])
    visited(catalog, [seen("inconsistent")], day=1, placement=IN_DOUBT)
    (change,) = catalog.changes.page(ChangeFilter(map_id="lobby")).items
    assert (change.survey_id, change.last_seen) == (first, NOON)
    third = visited(catalog, [seen("changed")], day=2, objects=[CRATE])
    (change,) = catalog.changes.page(ChangeFilter(map_id="lobby")).items
    assert (change.survey_id, change.last_seen) == (first, NOON + timedelta(days=2))
    repeated = catalog.changes.page(ChangeFilter(map_id="lobby", repeats=True)).items
    assert {each.survey_id for each in repeated} == {first, third}


def test_a_survey_in_doubt_that_does_not_find_an_object_has_not_looked(catalog: Catalog) -> None:
    add_map(catalog)
    visited(catalog, [seen("changed")], day=0, objects=[CRATE])
    visited(catalog, [seen("inconsistent")], day=1, placement=IN_DOUBT)
    found = the_object(catalog)
    assert (found.status, found.sightings, found.last_looked) == ("new", 1, NOON)
    visited(catalog, [seen("unchanged")], day=2, objects=[])
    assert the_object(catalog).status == "gone_again"


def test_a_survey_in_doubt_is_not_taken_over_by_the_map(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id = visited(catalog, [seen("inconsistent")], day=0, placement=IN_DOUBT)
    with pytest.raises(Conflict, match=r"in doubt \(confidence 0\.71\).*visit the place again"):
        catalog.versions.create("lobby", survey_id=survey_id)
    assert len(catalog.versions.page("lobby").items) == 1
    sure = visited(catalog, [seen("changed")], day=1)
    assert catalog.versions.create("lobby", survey_id=sure)[0].version == 2
