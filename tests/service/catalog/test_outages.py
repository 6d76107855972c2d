"""The database away, stopped, locked or full: what a caller is told, and when."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from service.catalog.sql.database import Database
from service.catalog.sql.patience import Patience
from service.errors import DatabaseUnavailable
from tests.support.servers import PostgreSQL, postgresql

HASTY = Patience(
    connect_s=2, lock_s=0.2, statement_s=1, write_s=3, blob_s=0.5, blob_request_s=1, blob_retry_s=0.1
)


def hasty(url: str) -> Database:
    return Database(url, patience=HASTY)


def touch(database: Database) -> None:
    """Write, and change nothing."""
    with database.write() as session:
        session.execute(text("UPDATE jobs SET message = message"))


@pytest.fixture
def sqlite(tmp_path: Path) -> Database:
    database = hasty(f"sqlite:///{tmp_path / 'spicd.sqlite'}")
    database.upgrade()
    return database


@pytest.fixture(scope="module")
def server() -> Iterator[PostgreSQL]:
    with postgresql() as server:
        yield server


@pytest.fixture
def postgres(server: PostgreSQL) -> Iterator[Database]:
    database = hasty(server.database())
    database.upgrade()
    yield database
    database.close()


def test_a_writer_does_not_wait_longer_than_its_patience_for_a_locked_sqlite(
    sqlite: Database, tmp_path: Path
) -> None:
    other = sqlite3.connect(tmp_path / "spicd.sqlite", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    started = time.monotonic()
    with pytest.raises(DatabaseUnavailable, match="database is locked"):
        touch(sqlite)
    assert time.monotonic() - started < 5
    sqlite.ping()  # who reads does not wait
    other.rollback()
    touch(sqlite)


def test_a_fault_of_ours_is_no_outage(sqlite: Database) -> None:
    with pytest.raises(OperationalError, match="no such table"), sqlite.read() as session:
        session.execute(text("SELECT 1 FROM nowhere"))


def test_a_file_that_is_gone_is_an_outage(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    database = hasty(f"sqlite:///{folder / 'spicd.sqlite'}")
    folder.rmdir()
    with pytest.raises(DatabaseUnavailable, match="unable to open database file"):
        database.ping()


@pytest.mark.slow
def test_a_server_that_is_not_there_is_an_outage() -> None:
    with pytest.raises(DatabaseUnavailable, match="does not answer"):
        hasty("postgresql://spicd:secret@127.0.0.1:1/spicd").ping()


@pytest.mark.slow
def test_a_frozen_postgresql_is_given_up_and_found_again(server: PostgreSQL, postgres: Database) -> None:
    postgres.ping()
    server.freeze()
    try:
        for _ in range(2):  # over a connection of the pool, and over a new one
            started = time.monotonic()
            with pytest.raises(DatabaseUnavailable):
                postgres.ping()
            assert time.monotonic() - started < 10
    finally:
        server.thaw()
    postgres.ping()


@pytest.mark.slow
def test_a_statement_that_takes_too_long_is_an_outage(postgres: Database) -> None:
    with pytest.raises(DatabaseUnavailable, match="QueryCanceled"), postgres.read() as session:
        session.execute(text("SELECT pg_sleep(20)"))
    with postgres.write() as session:
        session.execute(text("SELECT pg_sleep(2)"))  # who writes has longer
    with pytest.raises(DatabaseUnavailable, match="QueryCanceled"), postgres.write() as session:
        session.execute(text("SELECT pg_sleep(20)"))
    with pytest.raises(DatabaseUnavailable, match="QueryCanceled"), postgres.read() as session:
        session.execute(text("SELECT pg_sleep(2)"))  # over the connection that has written
    with pytest.raises(DatabaseUnavailable, match="LockNotAvailable"), postgres.write() as session:
        session.execute(text("LOCK TABLE jobs"))
        with postgres.write() as other:
            other.execute(text("LOCK TABLE jobs"))


@pytest.mark.slow
def test_a_postgresql_killed_within_a_transaction_is_found_again_after_its_restart(
    server: PostgreSQL, postgres: Database
) -> None:
    with pytest.raises(DatabaseUnavailable), postgres.write() as session:
        session.execute(text("SELECT 1 FROM jobs"))
        server.kill()
        session.execute(text("SELECT 1 FROM jobs"))
    with pytest.raises(DatabaseUnavailable):
        postgres.ping()
    server.start()
    postgres.ping()
    touch(postgres)
