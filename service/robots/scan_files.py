"""Whether a file of points is whole: what its header declares, held against its size, before anybody sends it.

PLY and PCD are known. A file of another format passes, and so does one whose header is not understood: the service says
what is wrong with it. No library is needed, and of a binary file nothing is read but its header.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

HEADER_LIMIT = 64 * 1024  #: bytes; no reader of the service takes a longer header
AGAIN = "copy or record it again"
_READ = 1 << 20
_PLY = re.compile(rb"ply[ \t]*\r?\n")
_PCD = re.compile(rb"\s*(#[^\n]*\.PCD|(VERSION|FIELDS|COLUMNS)\s)")
_PLY_SIZES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8,
}  # fmt: skip
_PACKED_SIZES = struct.Struct("<I")


class FileNotWhole(Exception):
    """A file that ends before its points do, or has none; `str()` says which, with the numbers."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Table:
    """Rows that a header declares, one behind the other."""

    n: int  #: rows
    numbers: int  #: in a row; a list counts as its length
    size: int  #: bytes of a row in binary; with lists the least that it may take
    is_fixed: bool = True  #: without lists, so that each row takes `size`


def require_whole(path: Path) -> None:
    """Raise FileNotWhole for a PLY or PCD that is empty, cut off or without points; OSError where it cannot be read."""
    size = path.stat().st_size
    if size == 0:
        raise FileNotWhole(f"the file is empty (0 bytes); {AGAIN}")
    with path.open("rb") as file:
        head = file.read(HEADER_LIMIT)
        try:
            if _PLY.match(head):
                _check_ply(file, head, size)
            elif _PCD.match(head):
                _check_pcd(file, head, size)
        except (ValueError, KeyError, IndexError):
            return  # no such header as this knows: the service says what it makes of it


def _check_ply(file: BinaryIO, head: bytes, size: int) -> None:
    lines, start = _header(head, size, last=("end_header",))
    encoding = next(words[1] for words in lines if words[:1] == ["format"])
    names = [words[1] for words in lines if words[:1] == ["element"]]
    if "vertex" not in names:
        raise FileNotWhole(f"no points are in the file: its header has no element 'vertex'; {AGAIN}")
    tables = _elements(lines)
    at = names.index("vertex")
    _require_points(tables[at].n)
    if encoding == "ascii":
        _check_lines(file, start, before=sum(table.n for table in tables[:at]), points=tables[at])
    elif all(table.is_fixed for table in tables[:at]):
        start += sum(table.n * table.size for table in tables[:at])
        _check_rows(tables[at], held=size - start)


def _elements(lines: Sequence[Sequence[str]]) -> list[_Table]:
    """Return the tables of a PLY in their order. Raises KeyError for a type that PLY does not know."""
    tables: list[_Table] = []
    for words in lines:
        if words[:1] == ["element"]:
            tables.append(_Table(n=int(words[2]), numbers=0, size=0))
        elif words[:1] == ["property"]:
            last, is_list = tables.pop(), words[1] == "list"
            size = last.size + _PLY_SIZES[words[2] if is_list else words[1]]
            is_fixed = last.is_fixed and not is_list
            tables.append(_Table(n=last.n, numbers=last.numbers + 1, size=size, is_fixed=is_fixed))
    return tables


def _check_pcd(file: BinaryIO, head: bytes, size: int) -> None:
    lines, start = _header(head, size, last=("DATA",))
    said = {words[0]: words[1:] for words in lines if words}
    sizes = [int(word) for word in said["SIZE"]]
    counts = [int(word) for word in said.get("COUNT", ["1"] * len(sizes))]
    n = int(said["POINTS"][0]) if "POINTS" in said else int(said["WIDTH"][0]) * int(said["HEIGHT"][0])
    _require_points(n)
    points = _Table(n=n, numbers=sum(counts), size=sum(a * b for a, b in zip(sizes, counts, strict=True)))
    if said["DATA"] == ["ascii"]:
        _check_lines(file, start, before=0, points=points)
    elif said["DATA"] == ["binary"]:
        _check_rows(points, held=size - start)
    elif said["DATA"] == ["binary_compressed"]:
        packed = _PACKED_SIZES.unpack_from(head, start)[0] if size >= start + 8 else 0
        held = max(0, size - start - 8)
        if size < start + 8 or held < packed:
            raise FileNotWhole(
                f"the file is cut off: {n} points are declared in {packed or 'compressed'} bytes, "
                f"{held} of them are there; {AGAIN}"
            )


def _header(head: bytes, size: int, *, last: Sequence[str]) -> tuple[list[list[str]], int]:
    """Return the words of the header's lines and where it ends. Raises FileNotWhole, ValueError for one without an end."""
    lines: list[list[str]] = []
    start = 0
    while (end := head.find(b"\n", start)) >= 0:
        words = head[start:end].decode("latin-1").split()
        start = end + 1
        lines.append(words)
        if words[:1] == list(last):
            return lines, start
    if size > len(head):
        raise ValueError("the header is longer than any")
    raise FileNotWhole(f"the file is cut off in its header, after {size} bytes; {AGAIN}")


def _require_points(n: int) -> None:
    if n == 0:
        raise FileNotWhole(f"no points are in the file: its header declares 0; {AGAIN}")


def _check_rows(points: _Table, *, held: int) -> None:
    """Check that so many bytes hold all points, in binary."""
    held = max(0, held)
    needed = points.n * points.size
    if held < needed:
        raise FileNotWhole(
            f"the file is cut off: its header declares {points.n} points ({needed} bytes), "
            f"{held // points.size} of them are there ({held} bytes); {AGAIN}"
        )


def _check_lines(file: BinaryIO, start: int, *, before: int, points: _Table) -> None:
    """Check that the text from `start` on has a line for each of the rows `before` and for each point."""
    file.seek(start)
    lines, last = 0, b""
    while piece := file.read(_READ):
        lines += piece.count(b"\n")
        last = (last + piece)[-HEADER_LIMIT:]
    lines += len(last.rpartition(b"\n")[2].split()) >= points.numbers  # a last line without an end
    if lines < before + points.n:
        there = max(0, lines - before)
        raise FileNotWhole(
            f"the file is cut off: its header declares {points.n} points, {there} of them are there; {AGAIN}"
        )
