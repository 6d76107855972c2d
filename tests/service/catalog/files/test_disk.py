"""The reserve and the ballast of a disk."""

from __future__ import annotations

import contextlib
import errno
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from service.catalog.catalog import Catalog
from service.catalog.files.blobs import Blobs
from service.catalog.files.disk import Disk
from service.catalog.sql.database import Database
from service.errors import DiskFull, QueueUnavailable, is_disk_full
from tests.support.samples import add_scan
from tests.support.small_disk import small_disk

HUGE = 1 << 60


def test_under_the_reserve_nothing_fits_and_without_one_everything_does(tmp_path: Path) -> None:
    Disk(tmp_path, reserve=1, ballast=0).require(coming=1000)
    Disk(tmp_path, reserve=0).require(coming=HUGE)
    with pytest.raises(DiskFull, match="SPICD_MIN_FREE_BYTES"):
        Disk(tmp_path, reserve=HUGE).require()
    with pytest.raises(DiskFull, match=f"{HUGE} bytes were to come"):
        Disk(tmp_path, reserve=1).require(coming=HUGE)


def test_the_ballast_is_given_up_once_for_what_deletes(tmp_path: Path) -> None:
    disk = Disk(tmp_path, reserve=0, ballast=4096)
    disk.load_ballast()
    tries: list[bool] = []

    def delete() -> str:
        tries.append((tmp_path / "ballast").exists())
        if tries == [True]:
            raise DiskFull("full")
        return "deleted"

    assert disk.freeing(delete) == "deleted"
    assert tries == [True, False]
    assert (tmp_path / "ballast").stat().st_size == 4096  # there was room for it again


def test_without_a_ballast_the_error_is_told(tmp_path: Path) -> None:
    def delete() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        Disk(tmp_path, reserve=0, ballast=0).freeing(delete)


def test_an_error_of_another_kind_costs_no_ballast(tmp_path: Path) -> None:
    disk = Disk(tmp_path, reserve=0, ballast=4096)
    disk.load_ballast()
    with pytest.raises(ZeroDivisionError):
        disk.freeing(lambda: 1 // 0)
    assert (tmp_path / "ballast").exists()


def chained() -> BaseException:
    try:
        try:
            raise OSError(errno.EDQUOT, "Disk quota exceeded")
        except OSError:
            raise RuntimeError("while saving") from None
    except RuntimeError as error:
        return error


def caused(cause: BaseException) -> BaseException:
    error = QueueUnavailable("the job queue does not answer")
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "full"),
    [
        (OSError(errno.ENOSPC, "x"), True),
        (OSError(errno.EIO, "x"), False),
        (caused(OSError(errno.ENOSPC, "x")), True),
        (caused(RuntimeError("MISCONF Errors writing to the AOF file: No space left on device")), True),
        (caused(RuntimeError("Connection refused")), False),
        (OperationalError("INSERT", {}, sqlite3.OperationalError("database is locked")), False),
        (DiskFull("x"), True),
        (chained(), False),  # `from None` says that it has nothing to do with it
    ],
)
def test_a_full_disk_is_known_by_any_of_its_names(error: BaseException, full: bool) -> None:
    assert is_disk_full(error) == full


@pytest.mark.slow
def test_a_full_disk_is_told_by_the_database_and_by_the_blobs(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 8) as disk:
        database = Database(f"sqlite:///{disk.folder / 'spicd.sqlite'}", keep_open=True)
        database.upgrade()
        blobs = Blobs((disk.folder / "blobs").as_uri())
        source = tmp_path / "source"
        source.write_bytes(bytes(1 << 20))
        disk.fill()
        for write in (
            lambda: blobs.put_bytes("a/b", bytes(1 << 20)),
            lambda: blobs.put_file("a/c", source, move=True),
            lambda: fill_a_table(database),
        ):
            with pytest.raises(DiskFull):
                write()
        database.ping()
        disk.clear()
        fill_a_table(database)
        blobs.put_file("a/c", source, move=True)
        database.close()


def fill_a_table(database: Database) -> None:
    with database.write() as session:
        connection = session.connection()
        connection.exec_driver_sql(
            "INSERT INTO tallies (name, labels, count, total) VALUES (?, ?, 0, 0)", ("name", "x" * (1 << 20))
        )
        connection.exec_driver_sql("DELETE FROM tallies")


def test_a_scan_whose_row_finds_no_space_leaves_no_file(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, turns = catalog.database.write, iter([False, True])  # the look at what is known, then the row

    @contextlib.contextmanager
    def full_at_the_second() -> Iterator[Session]:
        if next(turns):
            raise DiskFull("the disk of the database is full")
        with write() as session:
            yield session

    monkeypatch.setattr(catalog.database, "write", full_at_the_second)
    with pytest.raises(DiskFull):
        add_scan(catalog)
    assert catalog.blobs.under("scans/") == []
