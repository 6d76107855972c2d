"""Blobs: files by key, in a local folder or in S3, through obstore.

A key is seen only when its bytes are complete: obstore writes aside and renames (or completes a multipart upload).
"""

from __future__ import annotations

import contextlib
import errno
import shutil
import tempfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import unquote, urlsplit
from uuid import uuid4

import obstore
from obstore.store import LocalStore, ObjectStore, from_url

from service.catalog import blob_keys

CHUNK = 1 << 20  #: bytes handed on at a time
_NO_LINKS = (
    errno.EPERM,
    errno.EACCES,
    errno.EOPNOTSUPP,
    errno.EMLINK,
    errno.EXDEV,
)  #: by file system, or no more
_PARTS_AT_ONCE = 2  #: obstore holds 12 parts of 5 MB by default, more than an upload may cost


class Blobs:
    """A key-value store of files; keys come from `service.catalog.blob_keys`."""

    def __init__(self, url: str) -> None:
        """Open `url`: `file:///folder` (made when absent) or what else obstore opens, such as `s3://bucket/prefix`."""
        parts = urlsplit(url)
        self._store: ObjectStore
        if parts.scheme == "file":
            self._root: Path | None = Path(unquote(parts.path))
            self._root.mkdir(parents=True, exist_ok=True)
            self._store = LocalStore(self._root)
        else:
            self._root = None
            self._store = from_url(url)

    def put_bytes(self, key: str, data: bytes) -> None:
        """Write `data` under `key`, replacing what was there."""
        obstore.put(self._store, key, data, max_concurrency=_PARTS_AT_ONCE)

    def put_file(self, key: str, path: Path, *, move: bool = False) -> None:
        """Write the file at `path` under `key`; with `move` it is renamed there if it lies on the same disk."""
        if move and self._root is not None and _renamed(path, self._root / key):
            return
        obstore.put(self._store, key, path, max_concurrency=_PARTS_AT_ONCE)
        if move:
            path.unlink(missing_ok=True)

    def copy(self, key: str, to: str) -> None:
        """Put what lies under `key` under `to` as well, replacing what was there. Raises FileNotFoundError.

        In a local folder both name one file on the disk where that can be: a blob is replaced, and never written to.
        """
        if self._root is None:
            obstore.copy(self._store, key, to)
        elif (source := self.path(key)) and not _linked(source, self._root / to):
            self.put_file(to, source)

    def under(self, prefix: str) -> list[str]:
        """Return the keys under the folder `prefix`, in order; what is still being written is not among them."""
        return sorted(str(entry["path"]) for page in obstore.list(self._store, prefix) for entry in page)

    def get_bytes(self, key: str) -> bytes:
        """Return the bytes under `key`. Raises FileNotFoundError."""
        return bytes(obstore.get(self._store, key).bytes())

    def exists(self, key: str) -> bool:
        """Tell whether something complete lies under `key`."""
        try:
            obstore.head(self._store, key)
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
            with copy.open("wb") as out:
                for chunk in self.stream(key):
                    out.write(chunk)
            yield copy

    def stream(self, key: str) -> Iterator[bytes]:
        """Return the bytes under `key` in pieces of about 1 MiB. Raises FileNotFoundError at the call, not later."""
        result = obstore.get(self._store, key)
        return (bytes(chunk) for chunk in result.stream(min_chunk_size=CHUNK))

    def size(self, key: str) -> int:
        """Return the number of bytes under `key`. Raises FileNotFoundError."""
        return int(obstore.head(self._store, key)["size"])

    def folders(self, prefix: str) -> list[str]:
        """Return the folders right under the folder `prefix`, each as a prefix of its keys, in order."""
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
        entries = (entry for page in obstore.list(self._store, prefix) for entry in page)
        return max((entry["last_modified"] for entry in entries), default=None)

    def delete_prefix(self, prefix: str) -> None:
        """Remove every blob whose key starts with the folder `prefix`; none is fine."""
        if self._root is not None:
            shutil.rmtree(self._root / prefix, ignore_errors=True)
            return
        for page in obstore.list(self._store, prefix):
            obstore.delete(self._store, [str(entry["path"]) for entry in page])

    def ping(self) -> None:
        """Write and remove a small blob, as an upload would. Raises what the store raises."""
        key = blob_keys.probe(uuid4().hex)
        self.put_bytes(key, b"ping")
        with contextlib.suppress(FileNotFoundError):
            obstore.delete(self._store, key)


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


def _renamed(source: Path, target: Path) -> bool:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        source.replace(target)
    except OSError as error:
        if error.errno == errno.EXDEV:
            return False
        raise
    return True
