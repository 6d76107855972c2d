"""A copy of everything that is kept, taken while the service runs, and a service made of such a copy.

The copy is a folder: `tables/` has a file of JSON lines for each table, all of one state of the database, `blobs/` the
files, and `backup.json`, written last, says that it is whole. It knows neither SQLite nor PostgreSQL, a folder nor S3:
what was copied from one can be restored to the other.

No lock is taken. A blob never changes under its key but to be written again with the same result, so it may be copied at
any time. What the tables name must have been written before them; so the blobs are copied first, then the tables, then
the blobs that came meanwhile. Who deletes something between these two leaves rows without files in the copy: then the
tables are copied once more, and do not have these rows.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any, TextIO, get_args

import sqlalchemy as sa
from sqlalchemy.orm import Session

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.sql.database import Database
from service.catalog.sql.patience import MIGRATIONS
from service.catalog.sql.tables import Base, UtcDateTime, now
from service.catalog.steps import STEPS, JobKind
from service.settings import Settings

FORMAT = 1
_MANIFEST = "backup.json"
_ATTEMPTS = 5  #: to find a state of the tables whose files are all there
_ROWS = 1000  #: read or written at a time

Row = dict[str, Any]


class BackupFailed(Exception):
    """The copy cannot be made, or not be restored; `str()` says why and what to do."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Backup:
    """What `backup.json` says of a copy."""

    format: int
    revision: str  #: of the tables
    created: str  #: RFC 3339
    tables: dict[str, dict[str, str]]  #: table, in the order of their references, to column to kind
    rows: dict[str, int]  #: by table
    blobs: int
    missing: tuple[str, ...]  #: files that rows name and that were not in the service's store either


def backup(settings: Settings, folder: Path) -> Backup:
    """Copy what the service of these settings keeps to `folder`, which is new or empty. Raises BackupFailed."""
    _make(folder)
    database = Database(settings.resolved_database_url(), patience=MIGRATIONS)
    source, target = Blobs(settings.resolved_blob_url()), _blobs_of(folder)
    try:
        revision = database.revision()
        if revision is None:
            raise BackupFailed("the database has no tables; name the data folder of a service that has run")
        copied: dict[str, str] = {}
        _copy_new(source, target, copied, folder)
        for _ in range(_ATTEMPTS):
            rows, needed = _copy_tables(database, folder)
            _copy_new(source, target, copied, folder)
            missing = sorted(needed - copied.keys())
            if not missing:
                break
        return _sealed(folder, revision, rows, len(copied), missing)
    finally:
        database.close()


@dataclass(frozen=True, kw_only=True, slots=True)
class Restored:
    """What a restore did."""

    copy: Backup
    keys: int  #: of the copy that were not here, and that are taken from now on


def restore(settings: Settings, folder: Path) -> Restored:
    """Fill the empty database and the blob store of these settings from a copy. Raises BackupFailed.

    API keys that are there already stay, for without one a container does not start; those of the copy come beside them.
    Rows come last and all at once, so that a restore that was interrupted can be started again. Jobs that had not ended
    begin anew with the next start of the service.
    """
    copy = _opened(folder)
    database = Database(settings.resolved_database_url(), patience=MIGRATIONS)
    keys = 0
    try:
        _require_empty(database, copy)
        database.upgrade(copy.revision)
        _put_back(folder, copy, Blobs(settings.resolved_blob_url()))
        with database.write() as session:
            for table, kinds in copy.tables.items():
                for rows in _batches(_rows_of(folder, table, kinds)):
                    if table == "keys":
                        keys += _add_keys(session, _table(table, kinds), rows)
                    else:
                        session.execute(_table(table, kinds).insert(), rows)
        database.upgrade()
        with database.write() as session:
            _begin_anew(session)
    finally:
        database.close()
    return Restored(copy=copy, keys=keys)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        taken = any(folder.iterdir())
    except OSError as error:
        raise BackupFailed(f"the folder {folder} cannot be used ({error.strerror})") from error
    if taken:
        raise BackupFailed(f"the folder {folder} is not empty; name a new one")
    with contextlib.suppress(
        PermissionError
    ):  # that of somebody else; what is written into it is still ours alone
        folder.chmod(0o700)


def _blobs_of(folder: Path) -> Blobs:
    return Blobs((folder / "blobs").absolute().as_uri())


def _copy_new(source: Blobs, target: Blobs, copied: dict[str, str], folder: Path) -> None:
    """Copy the blobs that `copied` (key to stamp) does not have, or has with another stamp; note them there."""
    for prefix in (f"{root}/" for root in blob_keys.ROOTS):
        for key, stamp in source.stamps(prefix).items():
            if copied.get(key) != stamp and _fetched(source, target, key, folder / "blob.part"):
                copied[key] = stamp


def _fetched(source: Blobs, target: Blobs, key: str, aside: Path) -> bool:
    """Copy one blob; False where it was deleted meanwhile."""
    try:
        with aside.open("wb") as file:
            file.writelines(source.stream(key))
    except FileNotFoundError:
        aside.unlink(missing_ok=True)
        return False
    target.put_file(key, aside, move=True)
    return True


def _copy_tables(database: Database, folder: Path) -> tuple[dict[str, int], set[str]]:
    """Write one state of every table; returns the rows of each, and the keys of the blobs that they name."""
    (folder / "tables").mkdir(exist_ok=True)
    counts: dict[str, int] = {}
    needed: set[str] = set()
    with database.snapshot() as session:
        for table in Base.metadata.sorted_tables:
            counts[table.name] = 0
            with _lines_of(folder, table.name).open("w", encoding="utf-8") as file:
                for row in session.execute(sa.select(table).execution_options(yield_per=_ROWS)).mappings():
                    file.write(json.dumps(dict(row), default=datetime.isoformat) + "\n")
                    counts[table.name] += 1
                    needed.update(_named(table.name, row))
                _sync(file)
    return counts, needed


def _named(table: str, row: Mapping[Any, Any]) -> Iterator[str]:
    """Yield the keys of the blobs without which a row is of no use."""
    if table == "scans":
        yield row["key"]
    elif row.get("status") != "ready":
        return
    elif table == "map_versions":
        yield from (
            key(row["job_id"])
            for key in (blob_keys.map_reference, blob_keys.map_manifest, blob_keys.map_cloud)
        )
        if row["tileset"] is not None:
            yield blob_keys.map_tileset(row["job_id"])
            yield blob_keys.map_tileset_contents(row["job_id"])
    elif table == "surveys":
        yield blob_keys.survey_cloud(row["id"])
        if row["tileset"] is not None:
            yield blob_keys.survey_tileset(row["id"])
            yield blob_keys.survey_tileset_contents(row["id"])
    elif table == "models":
        yield blob_keys.model_weights(row["job_id"])


def _sealed(folder: Path, revision: str, rows: dict[str, int], blobs: int, missing: Iterable[str]) -> Backup:
    """Write the manifest: from now on the copy is whole."""
    tables = {
        table.name: {column.name: _kind(column) for column in table.columns}
        for table in Base.metadata.sorted_tables
    }
    sealed = Backup(
        format=FORMAT,
        revision=revision,
        created=now().isoformat(),
        tables=tables,
        rows=rows,
        blobs=blobs,
        missing=tuple(missing),
    )
    aside = folder / f"{_MANIFEST}.part"
    with aside.open("w", encoding="utf-8") as file:
        file.write(json.dumps(asdict(sealed), indent=2) + "\n")
        _sync(file)
    aside.replace(folder / _MANIFEST)
    return sealed


def _sync(file: TextIO) -> None:
    """Have what was written on the disk: a manifest that outlives a power cut says that all the rest did."""
    file.flush()
    os.fsync(file.fileno())


def _opened(folder: Path) -> Backup:
    try:
        fields = json.loads((folder / _MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise BackupFailed(
            f"{folder} holds no whole backup: {_MANIFEST}, which is written last, is not there"
        ) from error
    if fields.get("format") != FORMAT:
        raise BackupFailed(
            f"the backup has format {fields.get('format')}, this release reads {FORMAT}; restore it with its own release"
        )
    return Backup(**{**fields, "missing": tuple(fields["missing"])})


def _require_empty(database: Database, copy: Backup) -> None:
    """Raise BackupFailed where the database holds more than API keys, or tables of another revision than the copy's."""
    revision = database.revision()
    if revision is None:
        return
    with database.read() as session:
        filled = [
            table.name
            for table in Base.metadata.sorted_tables
            if table.name != "keys" and session.scalar(sa.select(sa.literal(1)).select_from(table).limit(1))
        ]
    if filled:
        raise BackupFailed(
            f"the database is not empty ({', '.join(filled)}); name a new data folder, or a new database"
        )
    if revision != copy.revision:
        raise BackupFailed(
            f"the tables of the database are at revision {revision} and those of the copy at {copy.revision}; name a new "
            "data folder, or a database without tables, and make keys in it afterwards"
        )


def _add_keys(session: Session, table: sa.TableClause, rows: list[Row]) -> int:
    """Add the API keys that are not here; returns how many of them are valid. What was revoked here or there stays so."""
    here = set(session.scalars(sa.select(table.c.digest)))
    new = [row for row in rows if row["digest"] not in here]
    if new:
        session.execute(table.insert(), new)
    for row in rows:
        if row["digest"] in here and row["revoked"] is not None:
            same = sa.and_(table.c.digest == row["digest"], table.c.revoked.is_(None))
            session.execute(table.update().where(same).values(revoked=row["revoked"]))
    instant = now()
    return sum(row["revoked"] is None and (row["expires"] is None or row["expires"] > instant) for row in new)


def _put_back(folder: Path, copy: Backup, target: Blobs) -> None:
    """Write the blobs of the rows that are there; others are of what was deleted while the copy was taken."""
    owners = {
        blob_keys.owner_of(key)
        for table, kinds in copy.tables.items()
        for row in _rows_of(folder, table, kinds)
        for key in _owned(table, row)
    }
    source = _blobs_of(folder)
    for prefix in (f"{root}/" for root in blob_keys.ROOTS):
        for key in source.under(prefix):
            path = source.path(key)
            if path is not None and blob_keys.owner_of(key) in owners:
                target.put_file(key, path)


def _owned(table: str, row: Row) -> Iterator[str]:
    """Yield the folders, or a key in each, of the blobs that belong to a row, whatever its state."""
    if table == "scans":
        yield row["key"]
    elif table == "map_versions":
        yield blob_keys.map_folder(row["job_id"])
    elif table == "surveys":
        yield blob_keys.survey_folder(row["id"])
    elif table == "models":
        yield blob_keys.model_folder(row["job_id"])


def _begin_anew(session: Session) -> None:
    """Put every job that had not ended at its first step: what later ones rest on may have come after the tables."""
    jobs = Base.metadata.tables["jobs"]
    for kind in get_args(JobKind):
        session.execute(
            jobs.update()
            .where(jobs.c.kind == kind, jobs.c.status.in_(("accepted", "running")))
            .values(
                status="accepted",
                step=STEPS[kind][0].name,
                message="waiting",
                progress=0,
                attempts=0,
                interruptions=0,
                due=now(),
                begun=None,
                owner=None,
            )
        )


def _lines_of(folder: Path, table: str) -> Path:
    return folder / "tables" / f"{table}.jsonl"


def _rows_of(folder: Path, table: str, kinds: Mapping[str, str]) -> Iterator[Row]:
    instants = [name for name, kind in kinds.items() if kind == "instant"]
    with _lines_of(folder, table).open(encoding="utf-8") as file:
        for line in file:
            row: Row = json.loads(line)
            for name in instants:
                if row[name] is not None:
                    row[name] = datetime.fromisoformat(row[name])
            yield row


def _batches(rows: Iterator[Row]) -> Iterator[list[Row]]:
    while batch := list(islice(rows, _ROWS)):
        yield batch


def _kind(column: sa.Column[Any]) -> str:
    """Name how a column is written in JSON."""
    if isinstance(column.type, UtcDateTime):
        return "instant"
    return "json" if isinstance(column.type, sa.JSON) else "plain"


def _table(name: str, kinds: Mapping[str, str]) -> sa.TableClause:
    """Return a table as the copy has it, which may be of an earlier revision than this release."""
    types: dict[str, Any] = {"instant": UtcDateTime(), "json": sa.JSON(none_as_null=True), "plain": None}
    return sa.table(name, *(sa.column(column, types[kind]) for column, kind in kinds.items()))
