"""Blobs: files by key, in a local folder or in S3, through obstore.

A key is seen only when its bytes are complete: obstore writes aside and renames (or completes a multipart upload). What
was put is on the disk, not only in the memory of the system: an upload that was acknowledged outlives a power cut.
A store that hangs is given up after the limits of `patience.py`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import AsyncIterator, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit
from uuid import uuid4

import obstore
from obstore import exceptions
from obstore.store import LocalStore, ObjectStore, from_url

from service.catalog.files import blob_keys
from service.catalog.sql.patience import JOBS, Patience
from service.errors import BlobsUnavailable, DiskFull, is_disk_full

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig

CHUNK = 1 << 20  #: bytes handed on at a time
_NO_LINKS = (
    errno.EPERM,
    errno.EACCES,
    errno.EOPNOTSUPP,
    errno.EMLINK,
    errno.EXDEV,
)  #: by file system, or no more
_NO_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)  #: of folders, by file system
_PARTS_AT_ONCE = 2  #: obstore holds 12 parts of 5 MB by default, more than an upload may cost
_RETRIES = 3
_LONGEST_STREAM_S = 24 * 3600  #: a large blob to a slow client; that it stalls is noticed piece by piece
_WITHOUT_LIMITS = ("file", "memory")  #: schemes of stores that no network lies before


class Blobs:
    """A key-value store of files; keys come from `service.catalog.files.blob_keys`.

    Every method raises BlobsUnavailable when the store does not answer, and DiskFull when it has no space.
    """

    def __init__(self, url: str, *, patience: Patience = JOBS) -> None:
        """Open `url`: `file:///folder` (made when absent) or what else obstore opens, such as `s3://bucket/prefix`."""
        parts = urlsplit(url)
        self._root: Path | None = None
        self._store: ObjectStore
        self._streams: ObjectStore  #: the same one, for requests whose length nobody knows
        if parts.scheme == "file":
            self._root = Path(unquote(parts.path))
            with _errors():
                self._root.mkdir(parents=True, exist_ok=True)
            self._store = self._streams = LocalStore(self._root)
        elif parts.scheme in _WITHOUT_LIMITS:
            self._store = self._streams = from_url(url)
        else:
            self._store = _limited(url, patience, patience.blob_request_s)
            self._streams = _limited(url, patience, _LONGEST_STREAM_S)

    @property
    def is_local(self) -> bool:
        """Whether the blobs lie in a folder of this machine."""
        return self._root is not None

    def put_bytes(self, key: str, data: bytes) -> None:
        """Write `data` under `key`, replacing what was there."""
        with _errors():
            obstore.put(self._store, key, data, max_concurrency=_PARTS_AT_ONCE)
            self._sync(key)

    def put_file(self, key: str, path: Path, *, move: bool = False) -> None:
        """Write the file at `path` under `key`; with `move` it is renamed there if it lies on the same disk."""
        with _errors():
            if move and self._root is not None and _renamed(path, self._root / key):
                self._sync_folders(key)
                return
            obstore.put(self._store, key, path, max_concurrency=_PARTS_AT_ONCE)
            self._sync(key)
        if move:
            path.unlink(missing_ok=True)

    def copy(self, key: str, to: str) -> None:
        """Put what lies under `key` under `to` as well, replacing what was there. Raises FileNotFoundError.

        In a local folder both name one file on the disk where that can be: a blob is replaced, and never written to.
        """
        with _errors():
            if self._root is None:
                obstore.copy(self._store, key, to)
            elif (source := self.path(key)) and not _linked(source, self._root / to):
                self.put_file(to, source)
            else:
                self._sync_folders(to)

    def under(self, prefix: str) -> list[str]:
        """Return the keys under the folder `prefix`, in order; what is still being written is not among them."""
        with _errors():
            return sorted(str(entry["path"]) for page in obstore.list(self._store, prefix) for entry in page)

    def stamps(self, prefix: str) -> dict[str, str]:
        """Return the keys under the folder `prefix`, each with a stamp that another content would not have."""
        with _errors():
            entries = [entry for page in obstore.list(self._store, prefix) for entry in page]
        return {
            str(entry["path"]): f"{entry['size']} {entry['last_modified'].isoformat()} {entry['e_tag']}"
            for entry in entries
        }

    def get_bytes(self, key: str) -> bytes:
        """Return the bytes under `key`. Raises FileNotFoundError."""
        with _errors():
            return bytes(obstore.get(self._store, key).bytes())

    def get_range(self, key: str, offset: int, length: int) -> bytes:
        """Return `length` bytes from `offset` on, fewer where the blob ends before. Raises FileNotFoundError."""
        path = self.path(key)
        with _errors():
            size = path.stat().st_size if path is not None else self.size(key)
            length = max(min(length, size - offset), 0)
            if not length:
                return b""
            if path is None:
                return bytes(obstore.get_range(self._store, key, start=offset, length=length))
            with path.open("rb") as file:
                file.seek(offset)
                return file.read(length)

    def exists(self, key: str) -> bool:
        """Tell whether something complete lies under `key`."""
        try:
            self.size(key)
        except FileNotFoundError:
            return False
        return True

    def path(self, key: str) -> Path | None:
        """Return where the blob lies on this machine, or None when it is elsewhere. Raises FileNotFoundError."""
        if self._root is None:
            return None
        path = self._root / key
        if not path.is_file():
            raise FileNotFoundError(key)
        return path

    @contextlib.contextmanager
    def local(self, key: str) -> Iterator[Path]:
        """Yield a path to read the blob from: the file itself in a local folder, else a copy that goes at the end.

        Raises FileNotFoundError.
        """
        path = self.path(key)
        if path is not None:
            yield path
            return
        with tempfile.TemporaryDirectory(prefix="spicd-blob-") as folder:
            copy = Path(folder) / key.rsplit("/", 1)[-1]
            with _errors(), copy.open("wb") as out:
                for chunk in self.stream(key):
                    out.write(chunk)
            yield copy

    def stream(self, key: str) -> Iterator[bytes]:
        """Return the bytes under `key` in pieces of about 1 MiB. Raises FileNotFoundError at the call, not later."""
        with _errors():
            result = obstore.get(self._streams, key)
        return _pieces(result)

    async def open_stream(self, key: str) -> tuple[int, str, AsyncIterator[bytes]]:
        """Return size, stamp and bytes of a blob, these in pieces for the event loop: a stalled one holds no thread.

        Another content has another stamp.

        Raises FileNotFoundError.
        """
        with _errors():
            result = await obstore.get_async(self._streams, key)
        meta = result.meta
        stamp = f"{meta['size']} {meta['last_modified'].isoformat()} {meta['e_tag']}"
        return int(meta["size"]), stamp, _pieces_async(result)

    def size(self, key: str) -> int:
        """Return the number of bytes under `key`. Raises FileNotFoundError."""
        with _errors():
            return int(obstore.head(self._store, key)["size"])

    def folders(self, prefix: str) -> list[str]:
        """Return the folders right under the folder `prefix`, each as a prefix of its keys, in order."""
        with _errors():
            listed = obstore.list_with_delimiter(self._store, prefix)
        return sorted(f"{str(name).rstrip('/')}/" for name in listed["common_prefixes"])

    def written(self, prefix: str) -> datetime | None:
        """Return when the newest file under the folder `prefix` was written; None where nothing is there.

        In a local folder what was never written to its end counts too.
        """
        if self._root is not None:
            folder = self._root / prefix
            times = [path.stat().st_mtime for path in (folder, *folder.rglob("*")) if path.exists()]
            return datetime.fromtimestamp(max(times), UTC) if times else None
        with _errors():
            entries = (entry for page in obstore.list(self._store, prefix) for entry in page)
            return max((entry["last_modified"] for entry in entries), default=None)

    def delete_prefix(self, prefix: str) -> None:
        """Remove every blob whose key starts with the folder `prefix`; none is fine."""
        if self._root is not None:
            shutil.rmtree(self._root / prefix, ignore_errors=True)
            return
        with _errors():
            for page in obstore.list(self._store, prefix):
                obstore.delete(self._store, [str(entry["path"]) for entry in page])

    def ping(self) -> None:
        """Write and remove a small blob, as an upload would."""
        key = blob_keys.probe(uuid4().hex)
        with _errors():
            obstore.put(self._store, key, b"ping")
        with contextlib.suppress(FileNotFoundError), _errors():
            obstore.delete(self._store, key)

    def _sync(self, key: str) -> None:
        """Have a blob in a local folder on the disk; another store has it there when it says so."""
        if self._root is not None:
            _fsync(self._root / key)
            self._sync_folders(key)

    def _sync_folders(self, key: str) -> None:
        """Have the name of a blob on the disk, with those of the folders that it may have been the first in."""
        if self._root is not None:
            for number in range(key.count("/") + 1):
                _fsync((self._root / key).parents[number])


def _limited(url: str, patience: Patience, request_s: float) -> ObjectStore:
    """Open a store behind a network: `patience` for each piece of an answer, and `request_s` for all of it."""
    options: ClientConfig = {
        "connect_timeout": timedelta(seconds=patience.connect_s),
        "read_timeout": timedelta(seconds=patience.blob_s),
        "timeout": timedelta(seconds=request_s),
    }
    if os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes", "on"):
        options["allow_http"] = True  # obstore reads it by itself where no options are given
    retries: RetryConfig = {
        "max_retries": _RETRIES,
        "retry_timeout": timedelta(seconds=patience.blob_retry_s),
    }
    return from_url(url, client_options=options, retry_config=retries)


@contextlib.contextmanager
def _errors() -> Iterator[None]:
    """Raise DiskFull and BlobsUnavailable for what obstore and the system call errors; FileNotFoundError stays."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (exceptions.BaseError, OSError) as error:
        if is_disk_full(error):
            raise DiskFull("the disk of the blobs is full; delete surveys or maps, or enlarge it") from error
        raise BlobsUnavailable(
            f"the blob store does not answer ({_reason(error)}); try again shortly"
        ) from error


def _reason(error: Exception) -> str:
    """Name the cause in a few words: obstore's own begin with the request and end with a page of Rust."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = str(error)
    for mark, reason in _REASONS.items():
        if mark in text:
            return reason
    return text.partition("\n")[0].rpartition(" - ")[2][:200] or type(error).__name__


_REASONS = {
    "TimedOut": "no answer in time",
    "operation timed out": "no answer in time",
    "ConnectionRefused": "connection refused",
    "ConnectionReset": "connection reset",
    "IncompleteMessage": "the connection ended within the answer",
    "dns error": "the name of its host is not known",
}


def _pieces(result: obstore.GetResult) -> Iterator[bytes]:
    with _errors():
        for chunk in result.stream(min_chunk_size=CHUNK):
            yield bytes(chunk)


async def _pieces_async(result: obstore.GetResult) -> AsyncIterator[bytes]:
    with _errors():
        async for chunk in result.stream(min_chunk_size=CHUNK):
            yield bytes(chunk)


def _linked(source: Path, target: Path) -> bool:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        target.hardlink_to(source)
    except OSError as error:
        if error.errno in _NO_LINKS:
            return False
        raise
    return True


def _fsync(path: Path) -> None:
    """Return when what was written to a file, or which names a folder has, is on the disk (fsync(2)).

    Something that was deleted meanwhile needs it no more, and some file systems know no sync of folders.
    """
    with contextlib.suppress(FileNotFoundError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        except OSError as error:
            if error.errno not in _NO_SYNC:
                raise
        finally:
            os.close(descriptor)


def _renamed(source: Path, target: Path) -> bool:
    """Move a file that is on the disk before its name says that it is whole; False where that is another file system."""
    target.parent.mkdir(parents=True, exist_ok=True)
    _fsync(source)
    try:
        source.replace(target)
    except OSError as error:
        if error.errno == errno.EXDEV:
            return False
        raise
    return True
