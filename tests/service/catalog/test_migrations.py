"""A database of the last 0.1 build is brought up to date; one of an earlier or a later build is refused."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import inspect

from service.catalog.catalog import Catalog, open_catalog
from service.catalog.files import blob_keys
from service.catalog.findings.changes import ChangeFilter
from service.catalog.findings.objects import ObjectFilter
from service.catalog.sql.database import Database, WrongRevision
from service.settings import Settings
from service.up.embedded_redis import LaunchFailed
from service.up.launcher import _migrate
from tests.support.samples import BOUNDS, IDENTITY, add_survey, place, thing, tile

WRITTEN = Path(__file__).with_name("release_0_1_0.sql")


@pytest.fixture
def old(tmp_path: Path) -> Settings:
    """A data folder with the database that release 0.1.0 wrote: two versions of a map, a survey, a trained model."""
    settings = Settings(data_dir=tmp_path / "data")
    settings.data_dir.mkdir()
    run(settings, WRITTEN.read_text())
    return settings


@pytest.fixture
def opened(old: Settings) -> Iterator[Catalog]:
    catalog = open_catalog(old)
    yield catalog
    catalog.close()


def run(settings: Settings, script: str) -> None:
    connection = sqlite3.connect(settings.data_dir / "spicd.sqlite")
    connection.executescript(script)
    connection.close()


def test_the_map_of_the_last_build_is_read_as_it_was_written(opened: Catalog) -> None:
    lobby = opened.maps.get("lobby")
    assert (lobby.version, lobby.job_id, lobby.counts, lobby.bounds) == (1, "job-1", {"tiles": 4}, BOUNDS)
    assert lobby.anchor is not None
    assert (lobby.anchor.longitude, lobby.anchor.heading) == (13.4, 90)
    (scan,) = lobby.scans
    assert (scan.scan_id, scan.accepted, scan.fitness, scan.map_from_scan) == ("scan-1", True, 0.98, IDENTITY)
    building, ready = (
        opened.versions.get("lobby", one.version) for one in opened.versions.page("lobby").items
    )
    assert (building.version, building.base_version, building.status) == (2, 1, "building")
    assert [scan.scan_id for scan in building.scans] == ["scan-1", "scan-3"]
    assert (ready.version, ready.registration) == (1, {"scans": 1})


def test_the_survey_of_the_last_build_keeps_its_tiles(opened: Catalog) -> None:
    survey = opened.surveys.ready("survey-1")
    assert (survey.map_version, survey.threshold, survey.counts["changed"]) == (1, 0.5, 1)
    tiles = [change.tile for change in opened.changes.of_survey("survey-1")]
    assert tiles == [tile(0, 0), tile(1, 0, "unobserved")]


def test_the_survey_of_the_last_build_tells_no_objects_and_its_change_once(opened: Catalog) -> None:
    survey = opened.surveys.ready("survey-1")
    assert (survey.objects, survey.moving, opened.maps.get("lobby").objects) == (None, None, {})
    (change,) = opened.changes.page(ChangeFilter(map_id="lobby")).items
    assert change.tile == tile(0, 0)
    assert (change.tile.observed_share, change.tile.appeared, change.tile.disappeared) == (None, None, None)
    assert change.first_seen == change.last_seen == survey.captured_at
    later, _ = add_survey(
        opened,
        [tile(0, 0)],
        captured_at=survey.captured_at + timedelta(days=1),
        objects=[thing(1, now=place(1, 1))],
    )
    (change,) = opened.changes.page(ChangeFilter(map_id="lobby")).items
    assert (change.survey_id, change.last_seen) == ("survey-1", survey.captured_at + timedelta(days=1))
    assert opened.surveys.get(later).objects == {"appeared": 1, "disappeared": 0, "moved": 0}


def test_a_sentence_of_the_last_build_is_the_detail_of_a_scan_without_a_reason(old: Settings) -> None:
    run(old, "UPDATE survey_scans SET accepted = 0, fitness = 0.1, reason = 'visit.pcd: fitness 0.10'")
    catalog = open_catalog(old)
    (survey_scan,) = catalog.surveys.get("survey-1").scans
    (map_scan,) = catalog.maps.get("lobby").scans
    catalog.close()
    assert (survey_scan.accepted, survey_scan.reason) == (False, None)
    assert survey_scan.detail == "visit.pcd: fitness 0.10"
    assert (survey_scan.numbers, survey_scan.candidates, survey_scan.warnings) == (None, None, ())
    assert (map_scan.reason, map_scan.detail, map_scan.confidence) == (None, None, None)


def test_each_use_of_a_scan_of_the_last_build_has_the_pose_of_its_upload(old: Settings) -> None:
    run(old, f"UPDATE scans SET pose = '{[list(row) for row in IDENTITY]}' WHERE id = 'scan-1'")
    catalog = open_catalog(old)
    (map_scan,), (survey_scan,) = catalog.maps.get("lobby").scans, catalog.surveys.get("survey-1").scans
    told = [catalog.scans.get(scan.scan_id).pose for scan in (map_scan, survey_scan)]
    catalog.close()
    assert (map_scan.pose, survey_scan.pose) == (told[0], told[1])
    assert map_scan.pose == IDENTITY


def test_of_a_survey_of_the_last_build_nobody_judged_the_placement(opened: Catalog) -> None:
    assert opened.surveys.get("survey-1").placement is None


def test_what_a_version_of_the_last_build_took_over_is_known(old: Settings) -> None:
    run(
        old,
        "UPDATE map_versions SET status = 'ready', survey_id = 'survey-1', bounds = NULL WHERE number = 2",
    )
    catalog = open_catalog(old)
    when = catalog.surveys.get("survey-1").captured_at + timedelta(days=1)
    survey_id, _ = add_survey(
        catalog, [tile(0, 0)], captured_at=when
    )  # against version 2, which has what was there
    told = catalog.changes.page(ChangeFilter(map_id="lobby")).items
    catalog.close()
    assert [change.survey_id for change in told] == [survey_id, "survey-1"]


def test_what_moved_and_was_told_as_appeared_is_moved_again(old: Settings) -> None:
    """Before 0019 an object was of the kind that its latest sighting told, though nobody had looked at the other place."""
    catalog = open_catalog(old)
    start = catalog.surveys.get("survey-1").captured_at
    seen = [thing(1, now=place(1, 1), before=place(4, 1)), thing(1, now=place(1, 1))]
    for day, one in enumerate(seen, 1):
        add_survey(catalog, [tile(0, 0)], captured_at=start + timedelta(days=day), objects=[one])
    catalog.close()
    run(
        old,
        """UPDATE map_objects SET kind = 'appeared';
        ALTER TABLE map_objects DROP COLUMN other_survey_id;
        ALTER TABLE map_objects DROP COLUMN other_number;
        UPDATE alembic_version SET version_num = '0018'""",
    )
    catalog = open_catalog(old)
    (found,) = catalog.objects.page(ObjectFilter(map_id="lobby")).items
    catalog.close()
    assert (found.latest.thing.kind, found.latest.thing.before) == ("moved", seen[0].before)


def test_the_model_and_the_jobs_of_the_last_build_are_there(opened: Catalog) -> None:
    (model,) = opened.models.ready()
    assert (model.model, model.minutes, model.card) == (
        "lobby-net/1",
        5,
        {"name": "lobby-net", "version": "1", "threshold": 0.4},
    )
    assert [job.status for job in opened.jobs.page().items] == [
        "successful",
        "accepted",
        "successful",
        "successful",
    ]
    assert [job.job_id for job in opened.jobs.unfinished()] == ["job-3"]
    assert opened.scans.get("scan-2").key.startswith("scans/scan-2-")


def test_the_embedding_of_the_last_build_is_found_under_its_key() -> None:
    key = blob_keys.map_embedding("job-1", "spicd-net/1", "0123456789abcdef")
    assert key == "maps/job-1/description-spicd-net-1-0123456789ab.npz"


def test_work_goes_on_in_a_database_of_the_last_build(opened: Catalog) -> None:
    assert opened.jobs.begin("job-3", "register")
    outcomes = [scan.model_copy(update={"accepted": True}) for scan in opened.versions.get("lobby", 2).scans]
    opened.versions.save_result("job-3", outcomes=outcomes, bounds=BOUNDS, counts={"tiles": 5})
    assert opened.jobs.succeed("job-3")
    survey_id, _ = add_survey(opened, [tile(0, 0)])
    assert opened.surveys.ready(survey_id).map_version == 2
    opened.maps.delete("lobby")
    assert opened.jobs.page().items == []


def test_the_tables_of_the_last_build_become_those_of_a_new_database(old: Settings, tmp_path: Path) -> None:
    new = Database(f"sqlite:///{tmp_path / 'new.sqlite'}")
    new.upgrade()
    migrated = Database(old.resolved_database_url())
    migrated.upgrade()
    before, now = inspect(migrated.engine), inspect(new.engine)
    assert set(before.get_table_names()) == set(now.get_table_names())
    for table in now.get_table_names():
        assert describe(before, table) == describe(now, table)


def describe(inspector: object, table: str) -> dict[str, list[str]]:
    """Columns, keys and indices of a table, each in no particular order."""
    parts = ("get_columns", "get_foreign_keys", "get_indexes", "get_unique_constraints")
    return {part: sorted(map(str, getattr(inspector, part)(table))) for part in parts}


@pytest.mark.parametrize("revision", ["0001", "0004"])
def test_a_database_of_an_earlier_build_is_refused_with_what_to_do(old: Settings, revision: str) -> None:
    run(old, f"UPDATE alembic_version SET version_num = '{revision}'")
    with pytest.raises(WrongRevision, match=rf"revision {revision}.*last 0\.1 build.*empty data folder"):
        open_catalog(old)


def test_a_database_of_a_later_release_is_refused_as_well(old: Settings) -> None:
    run(old, "UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(WrongRevision, match="a newer release"):
        open_catalog(old)


def test_what_is_refused_stays_as_it_was(old: Settings) -> None:
    run(old, "UPDATE alembic_version SET version_num = '0003'")
    file = old.data_dir / "spicd.sqlite"
    before = list(sqlite3.connect(file).iterdump())
    with pytest.raises(WrongRevision):
        open_catalog(old)
    assert list(sqlite3.connect(file).iterdump()) == before


def test_spicd_up_says_in_one_sentence_why_it_does_not_start(old: Settings) -> None:
    run(old, "UPDATE alembic_version SET version_num = '0003'")
    with pytest.raises(
        LaunchFailed, match=r"cannot be opened: its tables are at revision 0003.*empty data folder"
    ):
        _migrate(old)
