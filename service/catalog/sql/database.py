"""The database: an engine from a URL, migrated under a lock, with sessions to read and to write.

Nothing here waits without a limit: not for a connection, a lock, a statement, nor for a server that took a statement
and says nothing more. Whoever opens it gives the limits (`patience.py`), and gets DatabaseUnavailable at their end.
"""

from __future__ import annotations

import contextlib
import fcntl
import sqlite3
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import URL, Connection, Engine, Select, create_engine, event, make_url, text, tuple_
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import InstrumentedAttribute, Session
from sqlalchemy.pool import NullPool

from service.catalog.records import Page, Position
from service.catalog.sql import postgresql
from service.catalog.sql.patience import JOBS, MIGRATIONS, Patience
from service.errors import DatabaseUnavailable, DiskFull, is_disk_full

R = TypeVar("R")
T = TypeVar("T")

FIRST_REVISION = "0005"  #: the tables of release 0.1, see migrations/versions
_MIGRATION_LOCK = 0x53504943  #: any number that every process of ours agrees on ("SPIC")
#: sqlite.org, result codes: BUSY, LOCKED, IOERR, CANTOPEN, PROTOCOL. The others are faults of ours.
_SQLITE_OUTAGES = (5, 6, 10, 14, 15)


class Database:
    """An engine and its sessions; `write()` takes the lock at once, so that no read turns stale before its write.

    Every method raises DatabaseUnavailable when the database does not answer, and DiskFull when it has no space.
    """

    def __init__(self, url: str, *, patience: Patience = JOBS, keep_open: bool = False) -> None:
        """Take `sqlite:///file` or `postgresql://...`; nothing is opened before it is needed.

        `keep_open` is for a process that does not fork: SQLite's log then stays between two connections, and on a full
        disk there is still one to read and to write with.
        """
        self._url = make_url(url)
        self._keeps_open = keep_open and self._url.get_backend_name() == "sqlite"
        self._kept: Connection | None = None
        self.engine = _engine(self._url, patience)
        self._writer = self.engine.execution_options(spicd_write=True)

    @contextlib.contextmanager
    def read(self) -> Iterator[Session]:
        """Open a session that sees one state of the database and changes nothing."""
        with _outages(), Session(self.engine) as session:
            yield session

    @contextlib.contextmanager
    def write(self) -> Iterator[Session]:
        """Open a session in one transaction: all of it is kept, or, when the block raises, none."""
        with _outages(), Session(self._writer) as session, session.begin():
            yield session

    def page(
        self,
        query: Select[R],
        created: InstrumentedAttribute[datetime],
        key: InstrumentedAttribute[str],
        record: Callable[[R], T],
        *,
        after: Position | None,
        limit: int,
    ) -> Page[T]:
        """Return a page of the rows of `query` as records, newest first, by keyset: stable while rows are added."""
        if after is not None:
            query = query.where(tuple_(created, key) < after)
        query = query.order_by(created.desc(), key.desc())
        with self.read() as session:
            records = [
                record(row) for row in session.scalars(query.limit(limit + 1))
            ]  # one more tells of a next page
        return Page(items=records[:limit], more=len(records) > limit)

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[Session]:
        """Open a session that sees one state of all tables for as long as it lasts, and changes nothing.

        A transaction of SQLite is that by itself; PostgreSQL would show each statement what was committed before it.
        """
        is_sqlite = self._url.get_backend_name() == "sqlite"
        engine = (
            self.engine if is_sqlite else self.engine.execution_options(isolation_level="REPEATABLE READ")
        )
        with _outages(), Session(engine) as session:
            yield session

    def upgrade(self, revision: str = "head") -> None:
        """Bring the tables up to date, or to `revision`; several processes may do so at once. Raises WrongRevision."""
        config = Config()
        config.set_main_option("script_location", "service.catalog:migrations")
        engine = _engine(self._url, MIGRATIONS)
        try:
            with _outages(), _migration_lock(engine):
                with engine.connect() as connection:
                    _check_revision(MigrationContext.configure(connection).get_current_revision(), config)
                with engine.connect() as connection:
                    config.attributes["connection"] = connection
                    command.upgrade(config, revision)
            if self._keeps_open:
                self._keep()
        finally:
            engine.dispose()

    def revision(self) -> str | None:
        """Return the revision of the tables; None where there are none."""
        with _outages(), self.engine.connect() as connection:
            return MigrationContext.configure(connection).get_current_revision()

    def ping(self) -> None:
        """Ask the tables something."""
        with self.read() as session:
            session.execute(text("SELECT 1 FROM jobs LIMIT 1"))

    def close(self) -> None:
        """Let go of every connection."""
        if self._kept is not None:
            self._kept.close()
            self._kept = None
        self.engine.dispose()

    def _keep(self) -> None:
        """Hold one connection open, idle, and past its first look: only then its log is mapped."""
        with _outages():
            if self._kept is None:
                self._kept = self.engine.connect()
            self._kept.execute(text("SELECT 1 FROM jobs LIMIT 1"))
            self._kept.rollback()


class WrongRevision(Exception):
    """The database has tables that this release cannot bring up to date; `str()` says what to do."""


def _check_revision(revision: str | None, config: Config) -> None:
    """Raise WrongRevision for a database of another release whose steps this one does not have."""
    if revision is None or revision in {
        step.revision for step in ScriptDirectory.from_config(config).walk_revisions()
    }:
        return
    if revision < FIRST_REVISION:
        raise WrongRevision(
            f"its tables are at revision {revision}, from before release 0.1 was complete; open it once with the last "
            "0.1 build, which brings it to revision 0005, or start with an empty data folder"
        )
    raise WrongRevision(
        f"its tables are at revision {revision}, which a newer release made; install that release, or start with an "
        "empty data folder"
    )


@contextlib.contextmanager
def _outages() -> Iterator[None]:
    """Raise DiskFull and DatabaseUnavailable for what the driver calls an outage; every other error stays what it is."""
    try:
        yield
    except (DBAPIError, PoolTimeout) as error:
        if is_disk_full(error):
            raise DiskFull(
                "the disk of the database is full; delete surveys or maps, or enlarge it"
            ) from error
        if not _is_outage(error):
            raise
        raise DatabaseUnavailable(
            f"the database does not answer ({_reason(error)}); try again shortly"
        ) from error


def _is_outage(error: DBAPIError | PoolTimeout) -> bool:
    if isinstance(error, PoolTimeout) or error.connection_invalidated:
        return True
    if isinstance(error.orig, sqlite3.Error):
        return (getattr(error.orig, "sqlite_errorcode", None) or 0) & 0xFF in _SQLITE_OUTAGES
    return isinstance(error, OperationalError | InterfaceError)


def _reason(error: DBAPIError | PoolTimeout) -> str:
    """Name the cause, without the address of the server, which the driver's sentence may hold."""
    if isinstance(error, PoolTimeout):
        return "no connection is free"
    if isinstance(error.orig, sqlite3.Error):
        return str(error.orig)
    state = getattr(error.orig, "sqlstate", None)
    return type(error.orig).__name__ if state is None else f"{type(error.orig).__name__}, {state}"


def _engine(url: URL, patience: Patience) -> Engine:
    if url.get_backend_name() == "sqlite":
        if url.database:
            Path(url.database).parent.mkdir(parents=True, exist_ok=True)
        # No pool: a connection opens in microseconds, and none may cross the fork of a worker.
        engine = create_engine(url, poolclass=NullPool, connect_args={"timeout": patience.lock_s})
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    if url.drivername in {"postgresql", "postgres"}:
        url = url.set(drivername="postgresql+psycopg")
    engine = create_engine(
        url,
        pool_pre_ping=True,
        pool_timeout=patience.lock_s,
        connect_args=postgresql.parameters(patience),
    )
    postgresql.limit(engine, patience)
    return engine


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    # The driver would begin only at the first write, after the reads that the write rests on.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")  # NORMAL may lose the last commits in a power cut
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    write = connection.get_execution_options().get("spicd_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


@contextlib.contextmanager
def _migration_lock(engine: Engine) -> Iterator[None]:
    if engine.dialect.name == "sqlite":
        with Path(f"{engine.url.database}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        return
    with engine.connect() as connection:
        connection.execute(text("SELECT pg_advisory_lock(:key)"), {"key": _MIGRATION_LOCK})
        try:
            yield
        finally:
            connection.execute(text("SELECT pg_advisory_unlock(:key)"), {"key": _MIGRATION_LOCK})
