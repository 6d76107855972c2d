"""A copy of everything, taken while things come and go, and a service made of it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import select

from service.catalog.catalog import Catalog, open_catalog
from service.catalog.files import blob_keys
from service.catalog.files.backup import BackupFailed, backup, restore
from service.catalog.keys import open_keys
from service.catalog.records import Tileset
from service.catalog.sql import tables
from service.catalog.sql.tables import Base
from service.cli import main
from service.settings import Settings
from tests.support.processes import until
from tests.support.samples import BOUNDS, NOON, add_map, add_scan, add_survey, place, thing, tile
from tests.support.servers import shared_parts


def fill(catalog: Catalog) -> None:
    """A map, a survey that is done, and one that is not."""
    job = add_map(catalog, "lobby")
    for key in (blob_keys.map_cloud, blob_keys.map_reference, blob_keys.map_manifest):
        catalog.blobs.put_bytes(key(job), b"built")
    objects = [thing(1, now=place(1, 1))]
    survey, _ = add_survey(
        catalog, [tile(0, 0, observed_share=0.9), tile(1, 0, "unobserved")], objects=objects
    )
    catalog.blobs.put_bytes(blob_keys.survey_cloud(survey), b"compared")
    _, running = add_survey(catalog, captured_at=NOON.replace(hour=13), ready=False)
    run = catalog.jobs.begin(running, "register")
    assert run is not None
    catalog.jobs.report(run, message="scoring", progress=0.5)


def content(catalog: Catalog) -> dict[str, list[tuple[object, ...]]]:
    """Every row of every table, but those of jobs, which begin anew."""
    with catalog.database.read() as session:
        return {
            table.name: sorted((tuple(row) for row in session.execute(select(table))), key=repr)
            for table in Base.metadata.sorted_tables
            if table.name != "jobs"
        }


def blobs(catalog: Catalog) -> dict[str, bytes]:
    keys = [key for root in blob_keys.ROOTS for key in catalog.blobs.under(f"{root}/")]
    return {key: catalog.blobs.get_bytes(key) for key in keys}


@pytest.fixture(params=["folder", pytest.param("elsewhere", marks=pytest.mark.slow)])
def other(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Settings]:
    """Where a copy goes: a data folder, or PostgreSQL and S3."""
    if request.param == "folder":
        yield Settings(data_dir=tmp_path / "other")
        return
    (tmp_path / "shared").mkdir()
    with shared_parts(tmp_path / "shared") as parts:
        for name, value in parts.items():
            if name.startswith("AWS_"):
                monkeypatch.setenv(name, value)
        yield Settings(
            data_dir=tmp_path / "other", database_url=parts["database_url"], blob_url=parts["blob_url"]
        )


def test_a_service_made_of_a_copy_has_what_the_first_one_had(
    catalog: Catalog, settings: Settings, other: Settings, tmp_path: Path
) -> None:
    fill(catalog)
    made = backup(settings, tmp_path / "copy")
    assert (made.missing, made.rows["surveys"], made.blobs) == ((), 2, len(blobs(catalog)))
    restore(other, tmp_path / "copy")
    restored = open_catalog(other)
    assert content(restored) == content(catalog)
    assert blobs(restored) == blobs(catalog)
    with pytest.raises(BackupFailed, match="not empty"):
        restore(other, tmp_path / "copy")
    backup(other, tmp_path / "again")  # and from there to a copy
    assert (tmp_path / "again/tables/surveys.jsonl").read_text() == (
        tmp_path / "copy/tables/surveys.jsonl"
    ).read_text()
    restored.close()


def test_a_job_that_had_not_ended_begins_anew(catalog: Catalog, settings: Settings, tmp_path: Path) -> None:
    fill(catalog)
    (unfinished,) = catalog.jobs.unfinished()
    backup(settings, tmp_path / "copy")
    other = Settings(data_dir=tmp_path / "other")
    restore(other, tmp_path / "copy")
    restored = open_catalog(other)
    (again,) = restored.jobs.unfinished()
    assert (again.job_id, again.status, again.progress) == (unfinished.job_id, "accepted", 0)
    with restored.database.read() as session:
        row = session.get_one(tables.Job, again.job_id)
        assert (row.step, row.attempts, row.begun, row.owner) == ("register", 0, None, None)
    restored.close()


@pytest.mark.slow
def test_of_a_copy_taken_while_surveys_come_and_go_every_row_has_its_files(
    catalog: Catalog, settings: Settings, tmp_path: Path
) -> None:
    fill(catalog)
    ended = threading.Event()
    rounds: list[str] = []

    def come_and_go() -> None:
        while not ended.is_set():
            scan = add_scan(catalog, f"scan-{len(rounds)}")
            survey, job = catalog.surveys.create("lobby", scan_ids=[scan.scan_id], model="spicd-net/1")
            catalog.blobs.put_bytes(blob_keys.survey_cloud(survey.survey_id), bytes(200_000))
            catalog.surveys.save_result(survey.survey_id, tiles=[tile(0, 0)], threshold=0.5)
            catalog.jobs.succeed(job.job_id)
            rounds.append(survey.survey_id)
            if len(rounds) > 5:
                catalog.surveys.delete(rounds[-5])

    robots = threading.Thread(target=come_and_go)
    robots.start()
    try:
        until(lambda: len(rounds) > 10)
        copies = [tmp_path / f"copy-{number}" for number in range(3)]
        made = [backup(settings, copy) for copy in copies]
    finally:
        ended.set()
        robots.join()
    for number, (copy, sealed) in enumerate(zip(copies, made, strict=True)):
        assert sealed.missing == ()
        other = Settings(data_dir=tmp_path / f"other-{number}")
        restore(other, copy)
        restored = open_catalog(other)
        for listed in restored.surveys.page("lobby").items:
            survey = restored.surveys.get(listed.survey_id)
            if survey.status == "ready":
                assert restored.blobs.exists(blob_keys.survey_cloud(survey.survey_id))
            for scan in survey.scans:
                assert restored.blobs.exists(restored.scans.get(scan.scan_id).key)
        restored.close()


def test_what_is_no_whole_copy_is_not_restored(catalog: Catalog, settings: Settings, tmp_path: Path) -> None:
    fill(catalog)
    backup(settings, tmp_path / "copy")
    with pytest.raises(BackupFailed, match="is not empty"):
        backup(settings, tmp_path / "copy")
    (tmp_path / "copy" / "backup.json").unlink()
    with pytest.raises(BackupFailed, match="holds no whole backup"):
        restore(Settings(data_dir=tmp_path / "other"), tmp_path / "copy")


def test_files_that_are_nowhere_are_named(catalog: Catalog, settings: Settings, tmp_path: Path) -> None:
    fill(catalog)
    catalog.blobs.delete_prefix("surveys/")
    (missing,) = backup(settings, tmp_path / "copy").missing
    assert missing.endswith("/cloud.ply")


def test_a_tileset_that_is_nowhere_is_named_too(catalog: Catalog, settings: Settings, tmp_path: Path) -> None:
    fill(catalog)
    record = catalog.maps.get("lobby")
    told = Tileset(n_points=3, contents=1, bytes=64, sha256="0" * 64)
    catalog.versions.save_result(
        record.job_id, outcomes=[], bounds=BOUNDS, counts=record.counts, tileset=told
    )
    missing = backup(settings, tmp_path / "before").missing
    assert [key.rpartition("/")[2] for key in missing] == ["tileset.bin", "tileset.json"]
    for key in (blob_keys.map_tileset(record.job_id), blob_keys.map_tileset_contents(record.job_id)):
        catalog.blobs.put_bytes(key, b"{}")
    assert backup(settings, tmp_path / "after").missing == ()
    restore(Settings(data_dir=tmp_path / "other"), tmp_path / "after")
    restored = open_catalog(Settings(data_dir=tmp_path / "other"))
    assert restored.maps.get("lobby").tileset == told
    assert restored.blobs.get_bytes(blob_keys.map_tileset_contents(record.job_id)) == b"{}"
    restored.maps.delete("lobby")
    assert restored.blobs.under(blob_keys.map_folder(record.job_id)) == []
    restored.close()


def test_the_commands_copy_and_restore(
    catalog: Catalog,
    settings: Settings,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fill(catalog)
    if settings.database_url is not None:
        monkeypatch.setenv("SPICD_DATABASE_URL", settings.database_url)
    run("backup", str(tmp_path / "copy"), "--data-dir", str(settings.data_dir))
    monkeypatch.delenv("SPICD_DATABASE_URL", raising=False)
    run("restore", str(tmp_path / "copy"), "--data-dir", str(tmp_path / "other"))
    restored = open_catalog(Settings(data_dir=tmp_path / "other"))
    assert restored.maps.get("lobby").status == "ready"
    restored.close()
    assert "surveys" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        run("backup", str(tmp_path / "copy"), "--data-dir", str(settings.data_dir))
    assert ended.value.code == 1
    assert "is not empty" in capsys.readouterr().err


def run(*words: str) -> None:
    """Run one command, which ends with status 0 or raises."""
    try:
        main(list(words))
    except SystemExit as ended:
        if ended.code not in (0, None):
            raise


def test_nobody_else_on_the_machine_reads_a_copy_or_what_was_restored(
    catalog: Catalog, settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(catalog)
    if settings.database_url is not None:
        monkeypatch.setenv("SPICD_DATABASE_URL", settings.database_url)
    copy, other = tmp_path / "copy", tmp_path / "other"
    before = os.umask(0o022)
    try:
        for folder in (copy, other / "blobs"):
            folder.mkdir(parents=True)  # empty, and open to all
        run("backup", str(copy), "--data-dir", str(settings.data_dir))
        monkeypatch.delenv("SPICD_DATABASE_URL", raising=False)
        run("restore", str(copy), "--data-dir", str(other))
    finally:
        os.umask(before)
    paths = [path for folder in (copy, other) for path in (folder, *folder.rglob("*"))]
    assert len(paths) > 20
    assert [path for path in paths if path.stat().st_mode & 0o077] == []


def test_keys_that_are_there_stay_and_those_of_the_copy_come_beside_them(
    catalog: Catalog, settings: Settings, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(catalog)
    first, robot, gone, late = (f"spicd_{letter * 64}" for letter in "abcd")
    for secret in (robot, late):
        catalog.keys.add("robot", scopes=["scans:write"], secret=secret)
    for secret in (gone, first):
        catalog.keys.revoke(catalog.keys.add("old", scopes=["admin"], secret=secret)[0].key_id)
    backup(settings, tmp_path / "copy")
    other = Settings(data_dir=tmp_path / "other")
    with open_keys(other) as keys:  # as a container does before the service ever ran
        keys.add("first", scopes=["admin"], secret=first)
        mine, _ = keys.add("mine", scopes=["admin"], secret=f"spicd_{'e' * 64}")
        keys.revoke(keys.add("robot", scopes=["scans:write"], secret=late)[0].key_id)
    run("restore", str(tmp_path / "copy"), "--data-dir", str(tmp_path / "other"))
    with open_keys(other) as keys:
        valid = {key.name: key for key in keys.all() if key.revoked is None}
        assert set(valid) == {"mine", "robot"}
        assert valid["mine"] == mine
        found = keys.find(robot)
        assert found is not None
        assert found.key_id == valid["robot"].key_id
        assert len(keys.all()) == 5
    said = capsys.readouterr()
    assert "API keys of the copy that are valid again: 1;" in " ".join(said.err.split())


def test_a_database_of_another_revision_that_has_keys_is_not_mixed_with_the_copy(
    catalog: Catalog, settings: Settings, tmp_path: Path
) -> None:
    fill(catalog)
    newest = backup(settings, tmp_path / "copy").revision
    manifest = tmp_path / "copy/backup.json"
    manifest.write_text(manifest.read_text().replace(f'"{newest}"', '"0007"'))
    other = Settings(data_dir=tmp_path / "other")
    with open_keys(other) as keys:
        keys.add("first", scopes=["admin"])
    with pytest.raises(BackupFailed, match=f"at revision {newest} and those of the copy at 0007"):
        restore(other, tmp_path / "copy")


def test_the_manifest_gets_its_name_when_all_the_rest_is_on_the_disk(
    catalog: Catalog, settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    monkeypatch.setattr(
        os, "fsync", lambda number: synced.append(str(Path(f"/proc/self/fd/{number}").readlink()))
    )
    fill(catalog)
    backup(settings, tmp_path / "copy")
    lines = [str(path) for path in (tmp_path / "copy/tables").iterdir()]
    assert len(lines) == len(Base.metadata.sorted_tables)
    assert set(lines) <= set(synced)
    assert synced[-1] == str(tmp_path / "copy/backup.json.part")
