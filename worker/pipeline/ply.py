"""PLY, the Stanford polygon format: ascii and binary of both byte orders, and binary written.

The points are the element `vertex`. Elements before it are walked over, lists included, and elements after it
are only checked for being there.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.errors import ScanError, ScanTooLarge
from worker.pipeline.ply_header import SHORT_NAMES, Element, PlyHeader, parse_ply_header
from worker.pipeline.records import (
    HEADER_LIMIT,
    Columns,
    RawCloud,
    chosen_fields,
    from_rows,
    stride,
)
from worker.pipeline.text_rows import from_text, text_lines
from worker.pipeline.values import Colors, Points

_LIST_ROWS_LIMIT = 5_000_000  #: rows with lists that are walked one by one in Python, about 0.5 us each


def read_ply(buffer: mmap.mmap, *, max_points: int) -> RawCloud:
    """Decode the vertices of a PLY file. Raises ScanError, ScanTooLarge."""
    header = parse_ply_header(buffer[:HEADER_LIMIT])
    vertex = header.elements[header.vertex]
    if vertex.has_lists:
        raise ScanError("element 'vertex' has a list property; write the points without lists")
    chosen_fields([p.field for p in vertex.properties])
    if vertex.n > max_points:
        raise ScanTooLarge(
            f"header declares {vertex.n} points, the limit is {max_points}; split or thin the scan"
        )
    read = _ascii if header.encoding == "ascii" else _binary
    return RawCloud(columns=read(header, buffer), sensor_pose=np.eye(4))


def _ascii(header: PlyHeader, buffer: mmap.mmap) -> Columns:
    buffer.seek(header.size)
    lines = text_lines(buffer)
    for element in header.elements[: header.vertex]:  # one line a row, whatever is in it
        found = sum(1 for _ in zip(range(element.n), lines, strict=False))
        if found < element.n:
            raise ScanError(
                f"truncated: element {element.name!r} declares {element.n} rows, file holds {found}"
            )
    vertex = header.elements[header.vertex]
    left = len(buffer) - buffer.tell()
    columns = from_text([p.field for p in vertex.properties], lines, n=vertex.n, size=left)
    if header.vertex == len(header.elements) - 1 and next(lines, None) is not None:
        raise ScanError(f"header declares {vertex.n} points, but more lines follow; correct the count")
    return columns


def _binary(header: PlyHeader, buffer: mmap.mmap) -> Columns:
    start = header.size
    for element in header.elements[: header.vertex]:
        start = _after(element, buffer, start)
    vertex, later = header.elements[header.vertex], header.elements[header.vertex + 1 :]
    fields = [p.field for p in vertex.properties]
    needed, held = vertex.n * stride(fields), len(buffer) - start
    if held < needed:
        raise ScanError(
            f"truncated: header declares {vertex.n} points ({needed} bytes), "
            f"file holds {held // stride(fields)} ({held} bytes); upload it again"
        )
    rest = held - needed
    if rest < sum(element.n * element.smallest_row for element in later):
        raise ScanError(f"truncated: {rest} bytes after the points cannot hold {[e.name for e in later]}")
    if not any(element.has_lists for element in later):
        rest -= sum(element.n * element.smallest_row for element in later)
        if rest and np.frombuffer(buffer, np.uint8, offset=len(buffer) - rest).any():
            raise ScanError(f"{rest} bytes follow after the declared data; correct the count of points")
    return from_rows(fields, buffer, offset=start, n=vertex.n)


def _after(element: Element, buffer: mmap.mmap, start: int) -> int:
    """Offset of the first byte behind `element`, every list walked by its own length."""
    if start + element.n * element.smallest_row > len(buffer):
        raise ScanError(
            f"truncated: element {element.name!r} declares {element.n} rows, the file ends before them"
        )
    if not element.has_lists:
        return start + element.n * element.smallest_row
    if element.n > _LIST_ROWS_LIMIT:
        raise ScanError(
            f"element {element.name!r} has {element.n} rows of lists before the points, "
            f"the limit is {_LIST_ROWS_LIMIT}; write the points first"
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
    """How to cross a row: bytes to skip, then the length of a list (or None) and the bytes of its values."""
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
) -> None:
    """Write binary little endian PLY: float x y z, uchar red green blue, then one property for each scalar (N,).

    Scalars of bool or uint8 become uchar, other integers int, floats float. The file appears whole or not at all.
    Raises ValueError for a scalar whose name is no word, whose length is not N or whose values do not fit.
    """
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", np.asarray(points, "<f4").T, strict=True))
    if colors is not None:
        columns |= dict(zip(("red", "green", "blue"), np.asarray(colors, np.uint8).T, strict=True))
    for name, values in (scalars or {}).items():
        if name in columns or re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name) is None:
            raise ValueError(f"scalar field {name!r} needs another name")
        columns[name] = _scalar(name, np.asarray(values))
    if any(column.shape != (len(points),) for column in columns.values()):
        raise ValueError(f"columns of {[len(c) for c in columns.values()]} values for {len(points)} points")
    words = {code: word for word, code in SHORT_NAMES.items()}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {words[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    rows = np.empty(len(points), np.dtype([(name, column.dtype) for name, column in columns.items()]))
    for name, column in columns.items():
        rows[name] = column
    aside = path.with_name(path.name + ".tmp")
    with aside.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        file.write(rows.tobytes())
    aside.replace(path)


def _scalar(name: str, values: NDArray[Any]) -> NDArray[Any]:
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
