"""Versions in the catalog: of many asked for at once one is made, and what comes late touches nothing."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
from sqlalchemy import event

from service.catalog.catalog import Catalog
from service.catalog.records import Problem, ScanOutcome, Tileset
from service.errors import Conflict, NotFound, NotReady
from tests.support.samples import BOUNDS, IDENTITY, add_map, add_scan, add_survey, add_version, tile

MOVED = ((1, 0, 0, 4), *IDENTITY[1:])
SURE = ScanOutcome(
    scan_id="",
    accepted=True,
    fitness=0.93,
    rmse=0.021,
    map_from_scan=IDENTITY,
    translation_sigma=0.0042,
    rotation_sigma=0.00085,
)


def test_of_many_versions_asked_for_at_once_exactly_one_is_made(catalog: Catalog) -> None:
    add_map(catalog)
    scan_ids = [add_scan(catalog, f"s{number}").scan_id for number in range(6)]
    together = Barrier(6)

    def ask(scan_id: str) -> bool:
        together.wait()
        try:
            catalog.versions.create("lobby", scan_ids=[scan_id])
        except Conflict:
            return False
        return True

    with ThreadPoolExecutor(6) as pool:
        assert list(pool.map(ask, scan_ids)).count(True) == 1
    assert [found.version for found in catalog.versions.page("lobby").items] == [2, 1]
    assert len(catalog.jobs.page().items) == 2


def test_how_certain_a_scan_is_and_the_way_to_it_come_back_as_saved(catalog: Catalog) -> None:
    ids = [add_scan(catalog, name).scan_id for name in "abc"]
    _, job = catalog.maps.create(scan_ids=ids, model="m/1", map_id="hall")
    outcomes = [
        SURE.model_copy(update={"scan_id": scan_id, "path": tuple(ids[: number + 1])})
        for number, scan_id in enumerate(ids)
    ]
    totals = {"scans": 3, "mean_rmse": 0.021, "reference": ids[0]}
    catalog.versions.save_result(job.job_id, outcomes=outcomes, bounds=BOUNDS, counts={}, registration=totals)
    found = catalog.maps.get("hall")
    assert list(found.scans) == outcomes
    assert found.registration == totals
    assert catalog.versions.of_job(job.job_id).scans == found.scans


def test_of_a_survey_no_way_is_told_and_its_certainty_goes_on_into_the_version(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    (scan,) = catalog.surveys.get(survey_id).scans
    sure = SURE.model_copy(update={"scan_id": scan.scan_id})
    catalog.surveys.save_outcomes(survey_id, [sure])
    assert catalog.surveys.get(survey_id).scans == (sure,)
    version, _ = catalog.versions.create("lobby", survey_id=survey_id)
    assert version.scans[-1] == sure


def test_a_scan_of_a_survey_that_was_left_out_is_left_out_of_the_version(catalog: Catalog) -> None:
    add_map(catalog)
    ids = [add_scan(catalog, name).scan_id for name in ("seen", "astray")]
    survey, job = catalog.surveys.create("lobby", scan_ids=ids, model="m/1")
    astray = ScanOutcome(scan_id=ids[1], accepted=False, reason="no_fit", detail="fitness 0.10")
    catalog.surveys.save_outcomes(survey.survey_id, [SURE.model_copy(update={"scan_id": ids[0]}), astray])
    catalog.jobs.succeed(job.job_id)
    version, _ = catalog.versions.create("lobby", survey_id=survey.survey_id)
    assert [scan.scan_id for scan in version.scans][1:] == ids[:1]


def test_a_later_version_keeps_what_the_first_left_out_out(catalog: Catalog) -> None:
    first = add_map(catalog)
    (scan,) = catalog.maps.get("lobby").scans
    second = add_version(catalog)
    left_out = (
        catalog.versions.of_job(second).scans[1].model_copy(update={"accepted": False, "reason": "no_fit"})
    )
    catalog.versions.save_outcomes(second, [left_out])
    version, _ = catalog.versions.create("lobby", scan_ids=[add_scan(catalog, "third").scan_id])
    assert version.scans[0] == scan
    assert len(version.scans) == 2
    assert catalog.versions.of_job(first).scans == (scan,)


def test_a_late_step_of_a_deleted_version_touches_nothing(catalog: Catalog) -> None:
    add_map(catalog)
    late = add_version(catalog, ready=False)
    catalog.jobs.fail(late, Problem(code="map_failed", detail="-"))
    catalog.versions.delete("lobby", 2)
    before = catalog.maps.get("lobby")
    with pytest.raises(NotFound):
        catalog.versions.save_result(late, outcomes=[], bounds=BOUNDS, counts={"tiles": 99})
    with pytest.raises(NotFound):
        catalog.versions.of_job(late)
    assert not catalog.jobs.succeed(late)
    assert catalog.maps.get("lobby") == before


def test_a_map_whose_first_version_failed_is_deleted_as_a_whole_and_not_by_version(catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    catalog.jobs.fail(job_id, Problem(code="map_failed", detail="-"))
    with pytest.raises(Conflict):
        catalog.versions.delete("lobby", 1)
    with pytest.raises(NotReady):
        catalog.versions.ready("lobby", 1)
    catalog.maps.delete("lobby")
    with pytest.raises(NotFound):
        catalog.versions.page("lobby")


def test_an_anchor_moves_when_the_map_was_last_changed_and_nothing_else(catalog: Catalog) -> None:
    from service.catalog.records import Anchor

    add_map(catalog)
    before = catalog.maps.get("lobby")
    anchor = Anchor(longitude=13.4, latitude=52.5, height=70, heading=0)
    after = catalog.maps.set_anchor("lobby", anchor)
    assert after.updated > before.updated
    assert after.model_copy(update={"updated": before.updated, "anchor": None}) == before
    assert after.anchor == anchor


def test_a_version_keeps_the_poses_of_its_base_beside_those_of_its_own(catalog: Catalog) -> None:
    first, further = (add_scan(catalog, name, pose=IDENTITY).scan_id for name in ("first", "further"))
    _, job = catalog.maps.create(scan_ids=[first], poses={first: MOVED}, model="spicd-net/1", map_id="hall")
    catalog.versions.save_result(
        job.job_id, outcomes=[SURE.model_copy(update={"scan_id": first})], bounds=BOUNDS, counts={}
    )
    catalog.jobs.succeed(job.job_id)
    catalog.scans.correct(first, pose=IDENTITY)
    version, _ = catalog.versions.create("hall", scan_ids=[further], poses={further: MOVED})
    assert [scan.pose for scan in version.scans] == [MOVED, MOVED]


def test_the_tileset_of_a_version_is_told_without_its_scans(catalog: Catalog) -> None:
    job_id = add_map(catalog)
    with pytest.raises(NotFound, match="no tileset"):
        catalog.versions.tileset("lobby", 1)
    told = Tileset(n_points=3, contents=1, bytes=64, sha256="0" * 64)
    catalog.versions.save_result(job_id, outcomes=[], bounds=BOUNDS, counts={}, tileset=told)
    asked: list[str] = []

    def listen(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        asked.append(statement)

    event.listen(catalog.database.engine, "before_cursor_execute", listen)
    assert catalog.versions.tileset("lobby", 1) == (job_id, told)
    event.remove(catalog.database.engine, "before_cursor_execute", listen)
    assert asked
    assert not any("version_scans" in statement for statement in asked)
    with pytest.raises(NotFound, match="no version 2"):
        catalog.versions.tileset("lobby", 2)
    add_version(catalog, ready=False)
    with pytest.raises(NotReady, match="still building"):
        catalog.versions.tileset("lobby", 2)
