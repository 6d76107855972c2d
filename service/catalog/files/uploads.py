"""Resumable uploads: files that come in pieces, each in a folder of its own until it is whole and a scan.

    {upload_id}/data         the bytes; behind the offset of `state.json` they may be anything
    {upload_id}/state.json   what is known of the upload, written aside and renamed
    {upload_id}/lock         flock(2): one writer at a time, of whatever process on this host

The offset that is told is that of `state.json`, which is written when the bytes before it are on the disk (fsync). So
whatever is killed, and whenever, the upload goes on from an offset whose bytes are there.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import shutil
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

from pydantic import Field

from service.catalog.records import Problem, Record, ScanFormat, Utc
from service.catalog.sql.tables import now
from service.errors import DiskFull, NotFound, TooManyUploads, UploadBusy, is_disk_full

MAX_UPLOADS = 2000  #: that are begun or still remembered
_DATA, _STATE, _LOCK = "data", "state.json", "lock"
_ID = re.compile(r"[0-9a-f]{32}")
_YOUNG_S = 3600.0  #: of a folder without a state: it may just be made
_NO_LINKS = (errno.EPERM, errno.EACCES, errno.EOPNOTSUPP, errno.EMLINK, errno.EXDEV)


class UploadRecord(Record):
    """What is known of one upload."""

    upload_id: str = Field(examples=["5f0c2b1f5f0c2b1f5f0c2b1f5f0c2b1f"])
    length: int = Field(description="bytes of the whole file", examples=[1296000])
    offset: int = Field(
        description="bytes that are on the disk; the next piece begins here", examples=[262144]
    )
    metadata: dict[str, str] = Field(description="what was said of the scan with the upload")
    as_sent: str = Field(description="the same, as `Upload-Metadata` had it")
    created: Utc
    expires: Utc = Field(description="when it is forgotten, unless further bytes come")
    format: ScanFormat | None = Field(None, description="by the first bytes of the file")
    scan_id: str | None = Field(None, description="of the scan that it became", examples=["scan-2b1f"])
    problem: Problem | None = None  #: why it became none

    @property
    def is_whole(self) -> bool:
        """Whether every byte is here."""
        return self.offset == self.length

    @property
    def has_ended(self) -> bool:
        """Whether it is a scan, or was refused for good."""
        return self.scan_id is not None or self.problem is not None


class Uploads:
    """The uploads of one host; safe to share between threads and processes."""

    def __init__(self, folder: Path, *, keep: timedelta) -> None:
        """Keep them in `folder`, each for `keep` after its last byte."""
        self._folder = folder
        self._keep = keep

    def create(self, length: int, metadata: dict[str, str], as_sent: str) -> UploadRecord:
        """Begin an upload of `length` bytes. Raises TooManyUploads, DiskFull."""
        with _errors():
            self._folder.mkdir(parents=True, exist_ok=True)
            if sum(1 for _ in self._folder.iterdir()) >= MAX_UPLOADS:
                raise TooManyUploads(f"{MAX_UPLOADS} uploads are begun; finish some, or come again later")
            record = UploadRecord(
                upload_id=uuid4().hex,
                length=length,
                offset=0,
                metadata=metadata,
                as_sent=as_sent,
                created=now(),
                expires=now() + self._keep,
            )
            folder = self._folder / record.upload_id
            folder.mkdir()
            for name in (_DATA, _LOCK):
                (folder / name).touch()
            _write(folder, record)
            _fsync(self._folder)
        return record

    def get(self, upload_id: str) -> UploadRecord:
        """Return what is known of an upload, without waiting for who writes to it. Raises NotFound."""
        record = _read(self._path(upload_id))
        if record is None or record.expires < now():
            raise NotFound(f"no upload {upload_id!r}; it may have expired, begin another with POST /uploads")
        return record

    @contextlib.contextmanager
    def opened(self, upload_id: str) -> Iterator[OpenUpload]:
        """Hold an upload, which nobody else writes to meanwhile. Raises NotFound, and UploadBusy where somebody does."""
        folder = self._path(upload_id)
        with _locked(folder, upload_id):
            yield OpenUpload(folder, self.get(upload_id), self._keep)

    def sweep(self) -> int:
        """Remove uploads that have expired and what killed processes left; return how many. One in use stays."""
        removed = 0
        for folder in self._folder.iterdir() if self._folder.is_dir() else ():
            with contextlib.suppress(OSError, NotFound, UploadBusy):
                removed += self._removed(folder)
        return removed

    def _removed(self, folder: Path) -> bool:
        """Remove the folder of an upload that has expired, or that was never more than begun; whether it was."""
        record = _read(folder)
        if record is None:
            is_old = time.time() - folder.stat().st_mtime > _YOUNG_S
            if is_old:
                shutil.rmtree(folder, ignore_errors=True)
            return is_old
        if record.expires >= now():
            return False
        with _locked(folder, record.upload_id):
            shutil.rmtree(folder, ignore_errors=True)
        return True

    def _path(self, upload_id: str) -> Path:
        if not _ID.fullmatch(upload_id):
            raise NotFound(f"no upload {upload_id[:64]!r}; begin one with POST /uploads")
        return self._folder / upload_id


class OpenUpload:
    """An upload that is held: its methods block on the disk. Raises DiskFull wherever it writes."""

    def __init__(self, folder: Path, record: UploadRecord, keep: timedelta) -> None:
        self.record = record
        self._folder, self._keep = folder, keep
        self._end = record.offset  #: of what was written, on the disk or not

    @property
    def end(self) -> int:
        """The offset behind the last byte that was written, whether or not it is on the disk."""
        return self._end

    @property
    def missing(self) -> int:
        """Bytes that are still to come."""
        return self.record.length - self._end

    @property
    def path(self) -> Path:
        """Where the bytes are."""
        return self._folder / _DATA

    def append(self, data: bytes) -> None:
        """Write the next bytes."""
        with _errors(), self.path.open("r+b") as file:
            file.seek(self._end)
            file.write(data)
        self._end += len(data)

    def keep(self) -> None:
        """Have what was written on the disk, and only then say so."""
        with _errors():
            if self._end != self.record.offset:
                _fsync(self.path)
                self._update(offset=self._end, expires=now() + self._keep)

    def drop(self) -> None:
        """Forget what was written since it was kept last."""
        self._end = self.record.offset

    def head(self, size: int) -> bytes:
        """Return the first bytes of those that were written, `size` at most."""
        with self.path.open("rb") as file:
            return file.read(min(size, self._end))

    @contextlib.contextmanager
    def copy(self) -> Iterator[Path]:
        """Yield a file with the same bytes that may be moved away: another name of them, where the disk has that."""
        aside = self._folder / f"{uuid4().hex}.part"
        with _errors():
            os.truncate(self.path, self.record.length)
            try:
                aside.hardlink_to(self.path)
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
                shutil.copyfile(self.path, aside)
        try:
            yield aside
        finally:
            aside.unlink(missing_ok=True)

    def note_format(self, format: ScanFormat) -> None:
        """Note what the first bytes tell; written with the next piece that is kept."""
        self.record = self.record.model_copy(update={"format": format})

    def become(self, scan_id: str) -> None:
        """Note that the upload is a scan, and let its bytes go."""
        with _errors():
            self._update(scan_id=scan_id, expires=now() + self._keep)
        self.path.unlink(missing_ok=True)

    def refuse(self, problem: Problem) -> None:
        """Note for good why the upload is no scan, and let its bytes go."""
        with _errors():
            self._update(problem=problem, expires=now() + self._keep)
        self.path.unlink(missing_ok=True)

    def delete(self) -> None:
        """Remove the upload; the scan that it became stays."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _update(self, **values: Any) -> None:
        changed = self.record.model_copy(update=values)
        _write(self._folder, changed)
        self.record = changed


@contextlib.contextmanager
def _locked(folder: Path, upload_id: str) -> Iterator[None]:
    """Hold the lock of an upload; the system lets it go with the process. Raises UploadBusy, NotFound."""
    try:
        descriptor = os.open(folder / _LOCK, os.O_RDWR)
    except FileNotFoundError:
        raise NotFound(f"no upload {upload_id!r}; begin one with POST /uploads") from None
    try:
        _lock(descriptor, upload_id)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, upload_id: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UploadBusy(f"another request writes to upload {upload_id!r}; try again shortly") from None


def _read(folder: Path) -> UploadRecord | None:
    """Return the state in a folder; None where there is none, or none that this release can read."""
    try:
        return UploadRecord.model_validate_json((folder / _STATE).read_bytes())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None


def _write(folder: Path, record: UploadRecord) -> None:
    """Replace the state of an upload: after a power cut it is the old one or the new one."""
    aside = folder / f"{_STATE}.part"
    with aside.open("w") as file:
        file.write(record.model_dump_json())
        file.flush()
        os.fsync(file.fileno())
    aside.replace(folder / _STATE)
    _fsync(folder)


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _errors() -> Iterator[None]:
    """Raise DiskFull for what the system calls so."""
    try:
        yield
    except OSError as error:
        if not is_disk_full(error):
            raise
        raise DiskFull(
            "the disk of the data folder is full; delete surveys or maps, or enlarge it"
        ) from error
