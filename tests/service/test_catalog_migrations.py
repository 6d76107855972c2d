"""From the tables of maps without versions to those with them, and back, with rows in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from alembic import command
from alembic.config import Config
from sqlalchemy import inspect, text

from service.catalog import blob_keys
from service.catalog.catalog import open_catalog
from service.catalog.database import Database
from service.errors import NotFound
from tests.support.samples import add_map, add_survey, add_version, fresh_database, settings_in, tile

AT = "'2026-03-01 12:00:00+00:00'"
OLD_ROWS = (
    f"INSERT INTO scans (id, filename, format, size, sha256, key, created) VALUES ('scan-1', 'a', 'ply', 1, 'a', 'a', {AT})",
    "INSERT INTO maps (id, status, model, settings, bounds, counts, job_id, created, updated) VALUES "
    """('lobby', 'ready', 'm/1', '{"a": 1}', '{"min": [0, 0, 0], "max": [3, 3, 1]}', '{"tiles": 4}', 'job-1', """
    f"{AT}, {AT})",
    "INSERT INTO map_scans (map_id, scan_id, ordinal, accepted, fitness, map_from_scan) VALUES "
    "('lobby', 'scan-1', 0, true, 0.9, '[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]')",
    "INSERT INTO surveys (id, map_id, status, model, captured_at, counts, job_id, created, updated) VALUES "
    f"('survey-1', 'lobby', 'ready', 'm/1', {AT}, '{{}}', 'job-2', {AT}, {AT})",
    "INSERT INTO survey_scans (survey_id, scan_id, ordinal, accepted) VALUES ('survey-1', 'scan-1', 0, true)",
    "INSERT INTO jobs (id, kind, map_id, survey_id, status, message, progress, created, updated) VALUES "
    f"('job-1', 'map', 'lobby', NULL, 'successful', 'done', 100, {AT}, {AT}), "
    f"('job-2', 'survey', 'lobby', 'survey-1', 'successful', 'done', 100, {AT}, {AT})",
)


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database(fresh_database() or f"sqlite:///{tmp_path / 'data' / 'spicd.sqlite'}")


def migrate(database: Database, revision: str, *, down: bool = False) -> None:
    config = Config()
    config.set_main_option("script_location", "service.catalog:migrations")
    with database.engine.connect() as connection:
        config.attributes["connection"] = connection
        (command.downgrade if down else command.upgrade)(config, revision)
        connection.commit()


def rows(database: Database, query: str) -> list[tuple[Any, ...]]:
    with database.engine.connect() as connection:
        return [tuple(row) for row in connection.execute(text(query))]


def test_a_map_without_versions_becomes_version_1_of_itself(database, tmp_path):
    migrate(database, "0003")
    with database.write() as session:
        for statement in OLD_ROWS:
            session.execute(text(statement.replace(":", r"\:")))
    url = database.engine.url.render_as_string(hide_password=False)
    catalog = open_catalog(settings_in(tmp_path).model_copy(update={"database_url": url}))
    found = catalog.maps.ready("lobby")
    assert (found.version, found.job_id, found.counts, found.settings) == (1, "job-1", {"tiles": 4}, {"a": 1})
    assert found.bounds is not None
    assert found.bounds.max == (3, 3, 1)
    assert (found.anchor, found.registration) == (None, None)
    (scan,) = found.scans
    assert (scan.scan_id, scan.accepted, scan.fitness, scan.translation_sigma) == ("scan-1", True, 0.9, None)
    survey = catalog.surveys.ready("survey-1")  # dropping columns of maps took nothing with it
    assert (survey.map_version, survey.scans[0].accepted) == (1, True)
    assert len(catalog.jobs.page().items) == 2
    catalog.close()


def test_on_the_way_back_a_map_keeps_the_version_that_it_shows(database, tmp_path):
    url = database.engine.url.render_as_string(hide_password=False)
    catalog = open_catalog(settings_in(tmp_path).model_copy(update={"database_url": url}))
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    second = add_version(catalog)
    add_version(catalog, ready=False)
    add_map(catalog, "hall", ready=False)
    shown = {found.map_id: found for found in catalog.maps.page().items}
    catalog.close()
    migrate(database, "0003", down=True)
    assert rows(database, "SELECT id, status, job_id FROM maps ORDER BY id") == [
        ("hall", "building", shown["hall"].job_id),
        ("lobby", "ready", second),
    ]
    kept = rows(database, "SELECT map_id, scan_id FROM map_scans ORDER BY map_id, ordinal")
    assert kept == [(name, scan.scan_id) for name in ("hall", "lobby") for scan in shown[name].scans]
    assert rows(database, "SELECT id FROM surveys") == [(survey_id,)]
    assert rows(database, "SELECT count(*) FROM survey_tiles") == [(1,)]
    columns = {column["name"] for column in inspect(database.engine).get_columns("survey_scans")}
    assert not columns & {"path", "translation_sigma", "rotation_sigma"}
    assert not {"map_versions", "version_scans"} & set(inspect(database.engine).get_table_names())
    migrate(database, "head")
    again = open_catalog(settings_in(tmp_path / "again").model_copy(update={"database_url": url}))
    assert [found.version for found in again.versions.page("lobby").items] == [1]
    assert again.maps.ready("lobby").counts == shown["lobby"].counts
    assert again.maps.ready("lobby").bounds == shown["lobby"].bounds
    assert blob_keys.map_cloud(again.maps.ready("lobby").job_id) == blob_keys.map_cloud(second)
    with pytest.raises(NotFound):
        again.versions.get("lobby", 2)
    again.close()
