"""The database: tables as the migrations make them, for several processes at once."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from service.catalog.sql.database import Database
from service.catalog.sql.tables import Base


def url(folder: Path) -> str:
    return f"sqlite:///{folder / 'spicd.sqlite'}"


def open_and_ping(address: str) -> None:
    database = Database(address)
    database.upgrade()
    database.ping()


def test_the_migrations_make_the_tables_that_the_code_expects(tmp_path: Path) -> None:
    database = Database(url(tmp_path))
    database.upgrade()
    with database.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


@pytest.mark.slow
def test_three_processes_may_upgrade_one_new_database_at_once(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=open_and_ping, args=(url(tmp_path),)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 3


def test_sqlite_runs_with_wal_and_foreign_keys_and_has_commits_on_the_disk(tmp_path: Path) -> None:
    database = Database(url(tmp_path))
    with database.read() as session:
        assert session.scalar(text("PRAGMA journal_mode")) == "wal"
        assert session.scalar(text("PRAGMA foreign_keys")) == 1
        assert session.scalar(text("PRAGMA synchronous")) == 2  # FULL


def test_a_row_without_its_parent_is_refused(tmp_path: Path) -> None:
    database = Database(url(tmp_path))
    database.upgrade()
    with pytest.raises(IntegrityError), database.write() as session:
        session.execute(
            text("INSERT INTO version_scans (job_id, scan_id, ordinal) VALUES ('none', 'none', 0)")
        )


def test_a_write_that_raises_leaves_nothing(tmp_path: Path) -> None:
    database = Database(url(tmp_path))
    database.upgrade()
    insert = (
        "INSERT INTO scans (id, filename, format, size, sha256, key, created) "
        "VALUES ('a', 'a', 'ply', 1, 'a', 'a', '2026-03-01 12:00:00.000000')"
    )
    with pytest.raises(RuntimeError), database.write() as session:
        session.execute(text(insert))
        raise RuntimeError
    with database.read() as session:
        assert session.scalar(text("SELECT count(*) FROM scans")) == 0
