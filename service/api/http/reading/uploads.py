"""Files on their way in: written to disk in pieces, hashed on the way, and never parsed.

Only the first bytes are looked at: they tell PLY, PCD, E57, LAS and LAZ apart.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self
from uuid import uuid4

from service.catalog.records import ScanFormat
from service.errors import ScanUnreadable

AFTERWARDS_S = 3600.0  #: that a file may lie here when its body has ended, until the request has
_written_here: set[Path] = set()  #: files of requests that this process is at, whole or not
HEAD_BYTES = 256  #: bytes that are enough to tell the format
_PLY = re.compile(rb"ply[ \t]*\r?\n")
_PCD = re.compile(rb"\s*(#[^\n]*\.PCD|(VERSION|FIELDS|COLUMNS)\s)")
_E57, _LAS = b"ASTM-E57", b"LASF"
_LAS_FORMAT_AT = 104  #: byte of the header of a LAS; its highest two bits say that the points are packed
FORMATS = "PLY, PCD, E57, LAS or LAZ"


@dataclass(frozen=True, kw_only=True, slots=True)
class Upload:
    """One file that arrived whole."""

    path: Path  #: goes with the request, unless it was moved
    filename: str
    format: ScanFormat
    size: int  #: bytes
    sha256: str


class Incoming:
    """A file being written. Used as a context: what was not moved away by its end is removed."""

    def __init__(self, folder: Path, filename: str) -> None:
        """Open a file in `folder`; `filename` is the client's, is cut to one short line, and is not used as a path."""
        self.filename = shown(filename)
        self._path = folder / f"{uuid4().hex}.part"
        self._file = self._path.open("wb")
        _written_here.add(self._path)
        self._sha256 = hashlib.sha256()
        self._head = b""
        self._size = 0

    def write(self, data: bytes | memoryview) -> None:
        """Take the next piece."""
        if len(self._head) < HEAD_BYTES:
            self._head += bytes(data[: HEAD_BYTES - len(self._head)])
        self._file.write(data)
        self._sha256.update(data)
        self._size += len(data)

    def finish(self) -> Upload:
        """Return the whole file. Raises ScanUnreadable when it is of no format that is read."""
        self._file.close()
        return Upload(
            path=self._path,
            filename=self.filename,
            format=format_of(self._head, self.filename),
            size=self._size,
            sha256=self._sha256.hexdigest(),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        _written_here.discard(self._path)
        with contextlib.suppress(
            OSError
        ):  # a full disk tells of the last bytes once more; nobody wants them now
            self._file.close()
        self._path.unlink(missing_ok=True)


def sweep(folder: Path, *, upload_timeout_s: float) -> None:
    """Remove what uploads left that a killed process could not clean up; one that goes on in here keeps all its files.

    Of other processes on this folder nobody knows: a file that was whole early in a long form is not written again
    while the rest comes, so it stays for as long as any body may take.
    """
    for path in folder.glob("*.part"):
        with contextlib.suppress(OSError):  # another process sweeps as well
            old = time.time() - path.stat().st_mtime >= upload_timeout_s + AFTERWARDS_S
            if old and path not in _written_here:
                path.unlink()


def format_of(head: bytes, filename: str) -> ScanFormat:
    """Return the format that the first bytes of a file tell. Raises ScanUnreadable where it is none of those read."""
    if not head:
        raise ScanUnreadable(f"{filename}: the file is empty; send a {FORMATS}")
    if _PLY.match(head):
        return "ply"
    if _PCD.match(head):
        return "pcd"
    if head.startswith(_E57):
        return "e57"
    if head.startswith(_LAS):
        packed = len(head) > _LAS_FORMAT_AT and bool(head[_LAS_FORMAT_AT] & 0xC0)
        return "laz" if packed else "las"
    raise ScanUnreadable(
        f"{filename}: it starts with {head[:12]!r} and is none of {FORMATS}; send the scan as one of these"
    )


def shown(filename: str) -> str:
    """Return a client's name of a file as one short line."""
    return "".join(letter for letter in filename if letter.isprintable())[:255] or "scan"
