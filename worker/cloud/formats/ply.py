"""PLY files, version 1.0: a header in lines of text up to `end_header`, then the rows of each element.

Format: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import itertools
import mmap
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.fields import (
    HEADER_LIMIT,
    Columns,
    Field,
    RawCloud,
    check_point_count,
    chosen_fields,
    from_rows,
    from_text,
    header_line,
    rows_size,
    text_lines,
)
from worker.cloud.types import Colors, Points
from worker.errors import ScanError
from worker.files import write_parts

_SHORT_NAMES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
}  # fmt: skip
_LONG_NAMES = {
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_TYPES = _SHORT_NAMES | _LONG_NAMES
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
SCALAR = "scalar_"  #: what the names of scalar fields begin with (CloudCompare, PlyFilter)
_AT_ONCE = 1_000_000  # rows that are written together
_LISTS_LIMIT = 5_000_000  #: lists of an element that are walked one by one in Python, about 0.5 us each


@dataclass(frozen=True, kw_only=True, slots=True)
class Property:
    """One property of an element; a list when `length` is the type of its length."""

    field: Field  #: its name and the type of each value
    length: np.dtype[Any] | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Element:
    """One table of the file."""

    name: str
    n: int  #: rows
    properties: tuple[Property, ...]

    @property
    def smallest_row(self) -> int:
        """Bytes of a row in binary, with every list empty."""
        return sum(p.field.size if p.length is None else p.length.itemsize for p in self.properties)

    @property
    def has_lists(self) -> bool:
        """Whether its rows differ in size."""
        return any(p.length is not None for p in self.properties)


@dataclass(frozen=True, kw_only=True, slots=True)
class PlyHeader:
    """What the header declares; nothing of it is trusted before it is held against the file's size."""

    encoding: str  #: ascii, binary_little_endian or binary_big_endian
    elements: tuple[Element, ...]
    size: int  #: bytes of the header itself

    @property
    def vertex(self) -> int:
        """Index of the element that holds the points."""
        return [element.name for element in self.elements].index("vertex")


def looks_like_ply(head: bytes) -> bool:
    """Tell whether a file that starts with `head` means to be PLY."""
    return re.match(rb"ply[ \t]*\r?\n", head) is not None


def read_ply(buffer: mmap.mmap, *, max_points: int) -> RawCloud:
    """Decode the vertices of a PLY file. Raises ScanError, ScanTooLarge."""
    header = parse_ply_header(buffer[:HEADER_LIMIT])
    vertex = header.elements[header.vertex]
    if vertex.has_lists:
        raise ScanError("element 'vertex' has a list property; write the points without lists")
    chosen_fields([p.field for p in vertex.properties])
    check_point_count(vertex.n, max_points=max_points)
    decode = _ascii if header.encoding == "ascii" else _binary
    return RawCloud(columns=decode(header, buffer), sensor_pose=np.eye(4))


def parse_ply_header(head: bytes) -> PlyHeader:
    """Read the header out of a file's first bytes. Raises ScanError."""
    lines, size = _lines(head)
    encoding = _format(lines[0] if lines else [])
    elements: list[Element] = []
    for words in lines[1:]:
        match words:
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count):
                if name in [element.name for element in elements]:
                    raise ScanError(f"element {name[:40]!r} stands twice in the header")
                elements.append(Element(name=name, n=int(count), properties=()))
            case ["property", *rest] if elements:
                last = elements.pop()
                added = (*last.properties, _property(rest, _ORDERS[encoding]))
                elements.append(Element(name=last.name, n=last.n, properties=added))
            case _:
                raise ScanError(f"header line {' '.join(words)[:80]!r} cannot be understood")
    if "vertex" not in [element.name for element in elements]:
        raise ScanError("header has no element 'vertex', so there are no points in it")
    empty = [element.name for element in elements if element.n and not element.properties]
    if empty:
        raise ScanError(f"element {empty[0][:40]!r} has rows and no properties")
    return PlyHeader(encoding=encoding, elements=tuple(elements), size=size)


def _lines(head: bytes) -> tuple[list[list[str]], int]:
    """Return the words of each line between `ply` and `end_header` but comments, and the header's bytes."""
    lines: list[list[str]] = []
    position = head.find(b"\n") + 1
    while True:
        words, position = header_line(head, position, last="end_header")
        if words == ["end_header"]:
            return lines, position
        if words and words[0] not in ("comment", "obj_info"):
            lines.append(words)


def _format(words: list[str]) -> str:
    """Return the encoding that the format line names."""
    match words:
        case ["format", encoding, "1.0"] if encoding in _ORDERS:
            return encoding
    raise ScanError(f"second header line {' '.join(words)[:80]!r} is not a known 'format ... 1.0'")


def _property(words: list[str], order: str) -> Property:
    """Read what follows the word `property`; `order` is the byte order as NumPy writes it."""
    match words:
        case ["list", length, kind, name] if _TYPES.get(length, "f")[0] != "f" and kind in _TYPES:
            field = Field(name=name, dtype=np.dtype(order + _TYPES[kind]))
            return Property(field=field, length=np.dtype(order + _TYPES[length]))
        case [kind, name] if kind in _TYPES:
            return Property(field=Field(name=name, dtype=np.dtype(order + _TYPES[kind])), length=None)
    raise ScanError(f"property {' '.join(words)[:80]!r} has a type that PLY does not know")


def _ascii(header: PlyHeader, buffer: mmap.mmap) -> Columns:
    lines = text_lines(buffer, header.size)
    size = len(buffer) - header.size
    for element in header.elements[: header.vertex]:  # one line a row, whatever is in it
        if element.n * 2 - 1 > size:  # a row takes a character and its end
            raise ScanError(f"truncated: element {element.name!r} declares {element.n} rows in {size} bytes")
        held = sum(1 for _ in zip(range(element.n), lines, strict=False))
        if held < element.n:
            raise ScanError(
                f"truncated: element {element.name!r} declares {element.n} rows, file holds {held}"
            )
    vertex = header.elements[header.vertex]
    columns = from_text([p.field for p in vertex.properties], lines, n=vertex.n, size=size)
    if header.vertex == len(header.elements) - 1 and next(lines, None) is not None:
        raise ScanError(f"header declares {vertex.n} points, but more lines follow; correct the count")
    return columns


def _binary(header: PlyHeader, buffer: mmap.mmap) -> Columns:
    start = header.size
    for element in header.elements[: header.vertex]:
        start = _after(element, buffer, start)
    vertex, later = header.elements[header.vertex], header.elements[header.vertex + 1 :]
    fields = [p.field for p in vertex.properties]
    held = len(buffer) - start
    rest = held - rows_size(fields, n=vertex.n, held=held)
    least = sum(element.n * element.smallest_row for element in later)
    if rest < least:
        raise ScanError(f"truncated: {rest} bytes after the points cannot hold {[e.name for e in later]}")
    if not any(element.has_lists for element in later):
        rest -= least
        if rest and np.frombuffer(buffer, np.uint8, offset=len(buffer) - rest).any():
            raise ScanError(f"{rest} bytes follow after the declared data; correct the count of points")
    return from_rows(fields, buffer, offset=start, n=vertex.n)


def _after(element: Element, buffer: mmap.mmap, start: int) -> int:
    """Return the offset of the first byte behind `element`; every list is walked by its own length."""
    if start + element.n * element.smallest_row > len(buffer):
        raise ScanError(
            f"truncated: element {element.name!r} declares {element.n} rows, the file ends before them"
        )
    if not element.has_lists:
        return start + element.n * element.smallest_row
    lists = element.n * sum(p.length is not None for p in element.properties)
    if lists > _LISTS_LIMIT:
        raise ScanError(
            f"element {element.name!r} has {lists} lists before the points, "
            f"the limit is {_LISTS_LIMIT}; write the points first"
        )
    steps = list(_steps(element))
    try:
        for _ in range(element.n):
            for skip, length, item in steps:
                start += skip
                if length is not None:
                    (n_items,) = length.unpack_from(buffer, start)
                    if n_items < 0:
                        raise ScanError(f"element {element.name!r} has a list of {n_items} values")
                    start += length.size + n_items * item
    except struct.error:
        start = len(buffer) + 1
    if start > len(buffer):
        raise ScanError(f"truncated: the lists of element {element.name!r} run over the end of the file")
    return start


def _steps(element: Element) -> Iterator[tuple[int, struct.Struct | None, int]]:
    """Yield how to cross a row: bytes to skip, then the length of a list (or None) and the bytes of its values."""
    skip = 0
    for p in element.properties:
        if p.length is None:
            skip += p.field.size
        else:
            order = ">" if p.length.str[0] == ">" else "<"
            yield skip, struct.Struct(order + p.length.char), p.field.size
            skip = 0
    yield skip, None, 0


def write_ply(
    path: Path,
    points: Points,
    *,
    colors: Colors | None = None,
    scalars: Mapping[str, NDArray[Any]] | None = None,
    quality: NDArray[Any] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write binary little endian PLY: float x y z, uchar red green blue, then one property for each scalar (N,).

    A scalar `name` becomes the property `scalar_name`, which CloudCompare takes for a scalar field without being told;
    `quality` (N,) becomes the property of that name, the only number of a point that MeshLab reads. Comments are lines
    of ASCII. Scalars of bool or uint8 become uchar, other integers int, floats float. The file appears whole or not at all.
    Raises ValueError for a scalar whose name is no word, whose length is not N or whose values do not fit, and for a
    comment of more than a line.
    """
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", np.asarray(points, "<f4").T, strict=True))
    if colors is not None:
        columns |= dict(zip(("red", "green", "blue"), np.asarray(colors, np.uint8).T, strict=True))
    for name, values in (scalars or {}).items():
        if re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name) is None:
            raise ValueError(f"scalar field {name!r} needs another name")
        columns[SCALAR + name] = _scalar(name, np.asarray(values))
    if quality is not None:
        columns["quality"] = np.asarray(quality, "<f4")
    if any(column.shape != (len(points),) for column in columns.values()):
        raise ValueError(f"columns of {[len(c) for c in columns.values()]} values for {len(points)} points")
    words = {code: word for word, code in _SHORT_NAMES.items()}
    if any(re.fullmatch("[ -~]*", comment) is None for comment in comments):
        raise ValueError(f"comments {comments!r} are not one line of ASCII each")
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    header.append(f"element vertex {len(points)}")
    header += [f"property {words[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    head = "\n".join([*header, "end_header", ""]).encode("ascii")
    write_parts(path, itertools.chain([head], _rows(columns, len(points))))


def _rows(columns: Mapping[str, NDArray[Any]], count: int) -> Iterator[bytes]:
    """Yield the rows of these columns, some at a time."""
    kind = np.dtype([(name, column.dtype) for name, column in columns.items()])
    for start in range(0, count, _AT_ONCE):
        rows = np.empty(min(_AT_ONCE, count - start), kind)
        for name, column in columns.items():
            rows[name] = column[start : start + _AT_ONCE]
        yield rows.tobytes()


def _scalar(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Return the values as uchar, int or float; raise ValueError where none of them holds them."""
    if values.dtype.kind == "f":
        return values.astype("<f4")
    if values.dtype.kind == "b" or values.dtype == np.uint8:
        return values.astype("u1")
    limits = np.iinfo(np.int32)
    if values.dtype.kind not in "iu" or (
        values.size and not limits.min <= values.min() <= values.max() <= limits.max
    ):
        raise ValueError(f"scalar field {name!r} of {values.dtype} does not fit a PLY int")
    return values.astype("<i4")
