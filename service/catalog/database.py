"""The database: an engine from a URL, migrated under a lock, with sessions to read and to write."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, Select, create_engine, event, make_url, text, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session
from sqlalchemy.pool import NullPool

from service.catalog.records import Page, Position

R = TypeVar("R")
T = TypeVar("T")

BUSY_TIMEOUT_S = 30  #: how long a writer waits for another one
FIRST_REVISION = "0005"  #: the tables of release 0.1, see migrations/versions
_MIGRATION_LOCK = 0x53504943  #: any number that every process of ours agrees on ("SPIC")


class Database:
    """An engine and its sessions; `write()` takes the lock at once, so that no read turns stale before its write."""

    def __init__(self, url: str) -> None:
        """Take `sqlite:///file` or `postgresql://...`; nothing is opened before it is needed."""
        self.engine = _engine(url)
        self._writer = self.engine.execution_options(spicd_write=True)

    def read(self) -> Session:
        """Return a session, to be opened, that sees one state of the database and changes nothing."""
        return Session(self.engine)

    @contextlib.contextmanager
    def write(self) -> Iterator[Session]:
        """Open a session in one transaction: all of it is kept, or, when the block raises, none."""
        with Session(self._writer) as session, session.begin():
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

    def upgrade(self) -> None:
        """Bring the tables up to date; several processes may do so at once. Raises WrongRevision."""
        config = Config()
        config.set_main_option("script_location", "service.catalog:migrations")
        with _migration_lock(self.engine):
            with self.engine.connect() as connection:
                _check_revision(MigrationContext.configure(connection).get_current_revision(), config)
            with self.engine.connect() as connection:
                config.attributes["connection"] = connection
                command.upgrade(config, "head")

    def ping(self) -> None:
        """Ask the tables something. Raises what the driver raises."""
        with self.read() as session:
            session.execute(text("SELECT 1 FROM jobs LIMIT 1"))

    def close(self) -> None:
        """Let go of every connection."""
        self.engine.dispose()


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


def _engine(url: str) -> Engine:
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite":
        if parsed.database:
            Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
        # No pool: a connection opens in microseconds, and none may cross the fork of a worker.
        engine = create_engine(parsed, poolclass=NullPool, connect_args={"timeout": BUSY_TIMEOUT_S})
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    if parsed.drivername in {"postgresql", "postgres"}:
        parsed = parsed.set(drivername="postgresql+psycopg")
    return create_engine(parsed, pool_pre_ping=True)


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    # The driver would begin only at the first write, after the reads that the write rests on.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=NORMAL")
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
