"""A file of several scans is replaced by them, in a map's version and in a survey."""

from __future__ import annotations

from service.catalog.catalog import Catalog
from tests.support.samples import IDENTITY, MODEL, add_map, add_scan

MOVED = ((1.0, 0.0, 0.0, 4.0), *IDENTITY[1:])


def test_the_scans_of_a_file_stand_in_its_place_in_a_version(catalog: Catalog) -> None:
    first, file, last = (add_scan(catalog, name).scan_id for name in ("first", "file", "last"))
    one, two = (add_scan(catalog, name).scan_id for name in ("one", "two"))
    _, job = catalog.maps.create(scan_ids=[first, file, last], model=MODEL, map_id="lobby")
    for _ in range(2):  # a step may run twice
        catalog.versions.take_apart(job.job_id, file, {one: MOVED, two: None})
        scans = catalog.versions.of_job(job.job_id).scans
        assert [scan.scan_id for scan in scans] == [first, one, two, last]
        assert [scan.pose for scan in scans] == [None, MOVED, None, None]
    catalog.scans.delete(file)  # nothing rests on it any more


def test_a_file_that_has_more_is_kept_behind_its_scans(catalog: Catalog) -> None:
    add_map(catalog)
    first, file, last, one, two = (
        add_scan(catalog, name).scan_id for name in ("first", "file", "last", "one", "two")
    )
    survey, _ = catalog.surveys.create("lobby", scan_ids=[first, file, last], model=MODEL)
    for _ in range(2):  # a step may run twice
        catalog.surveys.take_apart(survey.survey_id, file, {one: MOVED, two: MOVED}, keep=True)
        scans = catalog.surveys.get(survey.survey_id).scans
        assert [scan.scan_id for scan in scans] == [first, one, two, file, last]


def test_a_scan_that_a_survey_names_beside_its_file_is_there_once(catalog: Catalog) -> None:
    add_map(catalog)
    file, one, two = (add_scan(catalog, name).scan_id for name in ("file", "one", "two"))
    survey, _ = catalog.surveys.create("lobby", scan_ids=[one, file], model=MODEL)
    catalog.surveys.take_apart(survey.survey_id, file, {one: MOVED, two: MOVED})
    scans = catalog.surveys.get(survey.survey_id).scans
    assert [(scan.scan_id, scan.pose) for scan in scans] == [(one, None), (two, MOVED)]
