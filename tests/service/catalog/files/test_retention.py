"""Retention: what is old and nothing rests on goes; everything else stays."""

from __future__ import annotations

import os
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import update

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys, retention
from service.catalog.sql import tables
from service.catalog.sql.tables import now
from service.errors import NotFound
from service.settings import Settings
from tests.service.catalog.test_tallies import counted
from tests.support.samples import NOON, add_map, add_scan, add_survey, add_version, tile

DAY = timedelta(days=1)


def aged(catalog: Catalog, days: float = 100) -> None:
    """Everything that is in the catalog came that long ago."""
    then = now() - days * DAY
    with catalog.database.write() as session:
        for table in (tables.Scan, tables.Survey):
            session.execute(update(table).values(created=then))


def policy(*, scans: float = 30, surveys: float = 30, at: datetime | None = None) -> retention.Policy:
    return retention.policy_of(Settings(keep_scans_days=scans, keep_surveys_days=surveys), at or now())


def swept(catalog: Catalog, given: retention.Policy) -> dict[str, int]:
    return retention.remove(catalog, given, retention.find(catalog, given))


def test_an_old_survey_goes_with_its_files_and_the_scans_that_were_in_it_alone(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, [tile(0, 0)])
    scan_id = catalog.surveys.get(survey_id).scans[0].scan_id
    key = blob_keys.survey_cloud(survey_id)
    catalog.blobs.put_bytes(key, b"cloud")
    aged(catalog)
    found = retention.find(catalog, policy())
    assert (found.surveys, found.scans, found.folders) == ((survey_id,), (scan_id,), ())
    assert catalog.surveys.get(survey_id)  # looking changes nothing
    assert swept(catalog, policy()) == {"surveys": 1, "scans": 1, "folders": 0}
    for get, gone in (
        (catalog.surveys.get, survey_id),
        (catalog.scans.get, scan_id),
        (catalog.jobs.get, job_id),
    ):
        with pytest.raises(NotFound):
            get(gone)
    assert not catalog.blobs.exists(key)
    assert catalog.blobs.folders("scans") == [
        blob_keys.folder_of(catalog.scans.get(scan.scan_id).key) for scan in catalog.maps.get("lobby").scans
    ]
    assert counted(catalog, "spicd_swept") == {("surveys",): (1, 1.0), ("scans",): (1, 1.0)}


def test_for_ever_is_the_default(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog)
    add_scan(catalog, "idle")
    aged(catalog, days=10_000)
    given = retention.policy_of(Settings(), now())
    assert retention.find(catalog, given) == retention.Leftovers(folders_known=3)


def test_scans_of_a_map_stay_and_so_do_those_of_a_survey_that_stays(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog)
    idle = add_scan(catalog, "idle")
    aged(catalog)
    assert retention.find(catalog, policy(surveys=0)).scans == (idle.scan_id,)
    assert swept(catalog, policy(surveys=0)) == {"surveys": 0, "scans": 1, "folders": 0}


def test_a_survey_that_a_version_took_over_stays_with_its_scans(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    add_version(catalog, survey_id=survey_id)
    aged(catalog)
    assert retention.find(catalog, policy()) == retention.Leftovers(folders_known=2)


def test_what_a_job_works_on_stays(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog, ready=False)
    aged(catalog)
    assert retention.find(catalog, policy()) == retention.Leftovers(folders_known=2)


def test_what_is_young_or_was_sent_again_lately_stays(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog)
    add_scan(catalog, "idle")
    aged(catalog, days=29)
    assert retention.find(catalog, policy()).scans == ()
    aged(catalog, days=31)
    add_scan(catalog, "idle")
    found = retention.find(catalog, policy())
    assert len(found.surveys) == 1
    assert catalog.scans.get(add_scan(catalog, "idle").scan_id).scan_id not in found.scans


def test_a_scan_that_is_used_or_sent_again_between_the_look_and_its_turn_stays(catalog: Catalog) -> None:
    add_map(catalog)
    used, sent = add_scan(catalog, "used"), add_scan(catalog, "sent")
    aged(catalog)
    found = retention.find(catalog, policy())
    assert set(found.scans) == {used.scan_id, sent.scan_id}
    catalog.surveys.create("lobby", scan_ids=[used.scan_id], model="spicd-net/1")
    add_scan(catalog, "sent")
    assert retention.remove(catalog, policy(), found) == {"surveys": 0, "scans": 0, "folders": 0}


def test_a_survey_that_is_taken_over_between_the_look_and_its_turn_stays(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    aged(catalog)
    found = retention.find(catalog, policy())
    add_version(catalog, survey_id=survey_id)
    assert retention.remove(catalog, policy(), found) == {"surveys": 0, "scans": 0, "folders": 0}
    assert catalog.surveys.get(survey_id)


def test_two_sweeps_of_one_list_do_no_harm(catalog: Catalog) -> None:
    add_map(catalog)
    add_survey(catalog)
    aged(catalog)
    found = retention.find(catalog, policy())
    assert retention.remove(catalog, policy(), found) == {"surveys": 1, "scans": 1, "folders": 0}
    assert retention.remove(catalog, policy(), found) == {"surveys": 0, "scans": 0, "folders": 0}


@pytest.mark.parametrize(
    "key",
    [
        "scans/scan-1-aa/hall.pcd",
        "surveys/survey-1/cloud.ply",
        "maps/job-1/scans/scan-1.npz",
        "models/job-1/epochs.csv",
        "surveys/survey-1/cloud.ply#1",  # a write that was cut off
    ],
)
def test_files_without_a_row_go_when_they_are_a_day_old(catalog: Catalog, key: str) -> None:
    add_map(catalog)
    add_survey(catalog, captured_at=NOON)
    path = Path(catalog.blobs._root or "") / key
    path.parent.mkdir(parents=True)
    path.write_bytes(b"left")
    folder = "/".join(key.split("/")[:2]) + "/"
    for days, gone in ((0.9, ()), (1.1, (folder,))):
        old = (now() - days * DAY).timestamp()
        for each in (path, *list(path.parents)[: key.count("/") - 1]):
            os.utime(each, (old, old))
        assert retention.find(catalog, policy(scans=0, surveys=0)).folders == gone
    assert swept(catalog, policy(scans=0, surveys=0))["folders"] == 1
    assert not path.parent.exists()
    assert len(catalog.blobs.folders("scans")) == 2


def test_files_of_another_database_are_told_from_what_kills_leave() -> None:
    def doubtful(unknown: int, *, known: int) -> bool:
        folders = tuple(f"scans/{number}/" for number in range(unknown))
        return retention.Leftovers(folders=folders, folders_known=known).doubtful

    assert not doubtful(0, known=0)
    assert doubtful(1, known=0)  # a fresh database beside files: none of them is known
    assert [doubtful(unknown, known=5) for unknown in (3, 4)] == [False, True]
    assert [doubtful(unknown, known=250) for unknown in (25, 26)] == [False, True]
    assert doubtful(200, known=1000)  # a database of last week
