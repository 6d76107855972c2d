"""Fields and columns: how one point lies in a file, and its positions and colours taken out of it.

PCD and PLY both describe a point as a row of named, typed fields. Both readers turn their header into
`Field`s; from there on the two formats are the same.
"""

from __future__ import annotations

import mmap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.types import Colors, Matrix4
from worker.errors import ScanError, ScanTooLarge

FARTHEST = 10_000.0  #: metres from the origin; there a float32 steps by 1 mm

HEADER_LIMIT = 64 * 1024  #: bytes; a longer header is refused unread
STRIDE_LIMIT = 64 * 1024  #: bytes of one point; SHOT, the widest descriptor in PCL, takes 1.4 kB
LINE_LIMIT = 1024 * 1024  #: bytes of one line
_NUMBERS_AT_ONCE = 1_000_000  #: decoded together, which bounds the memory of the columns nobody wants
_TEXT_AT_ONCE = 16 * LINE_LIMIT  #: bytes of lines decoded together, however long each is

_POSITION = ("x", "y", "z")
_TRIPLES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_PACKED = ("rgb", "rgba")

Columns = dict[str, NDArray[Any]]  #: (N,) arrays by field name


@dataclass(frozen=True, kw_only=True, slots=True)
class Field:
    """One named value of a point, `count` numbers of one type."""

    name: str
    dtype: np.dtype[Any]  #: with the file's byte order
    count: int = 1

    @property
    def size(self) -> int:
        """Bytes in one point."""
        return self.dtype.itemsize * self.count


@dataclass(frozen=True, kw_only=True, slots=True)
class RawCloud:
    """What a file holds, before anything is dropped or checked for sense."""

    columns: Columns  #: x, y, z (N,) float32 or float64, and the colour fields, each in the type of the file
    sensor_pose: Matrix4  #: (4, 4) float64, scan_from_sensor
    prior: Matrix4 | None = (
        None  #: (4, 4) float64, from the sensor to a frame of the file's own, where it tells one
    )
    tells_sensor: bool = True  #: whether the format can say where the sensor stood
    may_lie_anywhere: bool = False  #: positions are of float64, so that an offset can be taken off


def stride(fields: Sequence[Field]) -> int:
    """Return the bytes of one point."""
    return sum(field.size for field in fields)


def chosen_fields(fields: Sequence[Field]) -> dict[str, int]:
    """Choose the fields that are read, name to index; the others are skipped over.

    Raises ScanError when x, y or z is missing, doubled, or not one float or double, or a point is too wide.
    """
    if stride(fields) > STRIDE_LIMIT:
        raise ScanError(
            f"a point takes {stride(fields)} bytes, the limit is {STRIDE_LIMIT}; drop wide fields"
        )
    times = Counter(field.name for field in fields)
    index = {field.name: i for i, field in enumerate(fields)}
    for name in _POSITION:
        if times[name] != 1:
            raise ScanError(f"{times[name]} fields are named {name!r}, one is needed; write x, y and z once")
        field = fields[index[name]]
        if field.count != 1 or field.dtype.kind != "f":
            # Integers are some writer's private scale: reading them as metres would be a guess.
            kind = f"{field.count} x {field.dtype.name}"
            raise ScanError(f"field {name!r} is {kind}; write positions as one float or double in metres")
    single = {field.name: field for field in fields if field.count == 1 and times[field.name] == 1}
    return {name: index[name] for name in (*_POSITION, *_color_names(single))}


def _color_names(single: Mapping[str, Field]) -> tuple[str, ...]:
    """Choose the fields that colour a point, or none; a colour of another type is ignored like any other field.

    `single` are the fields of one number whose name stands once, by that name.
    """
    for triple in _TRIPLES:
        if all(name in single for name in triple):
            kinds = {single[name].dtype.newbyteorder("=").str[1:] for name in triple}
            return triple if len(kinds) == 1 and kinds <= {"u1", "f4", "f8"} else ()
    return next(((name,) for name in _PACKED if name in single and single[name].dtype.itemsize == 4), ())


def check_point_count(n: int, *, max_points: int) -> None:
    """Raise ScanTooLarge when a header declares more points than the limit."""
    if n > max_points:
        raise ScanTooLarge(f"header declares {n} points, the limit is {max_points}; split or thin the scan")


def rows_size(fields: Sequence[Field], *, n: int, held: int) -> int:
    """Return the bytes of `n` binary records; raise ScanError when the file has only `held` bytes left for them."""
    needed = n * stride(fields)
    if held < needed:
        raise ScanError(
            f"the file is cut off (truncated): header declares {n} points ({needed} bytes), "
            f"file holds {held // stride(fields)} ({held} bytes); copy or record it again"
        )
    return needed


def from_rows(fields: Sequence[Field], buffer: mmap.mmap, *, offset: int, n: int) -> Columns:
    """Return the columns of `n` records that lie one after another; the caller has checked that they are there."""
    starts = np.cumsum([0, *(field.size for field in fields)])
    chosen = chosen_fields(fields)
    record = np.dtype(
        {
            "names": list(chosen),
            "formats": [fields[i].dtype for i in chosen.values()],
            "offsets": [int(starts[i]) for i in chosen.values()],
            "itemsize": stride(fields),
        }
    )
    rows = np.frombuffer(buffer, record, count=n, offset=offset)
    return {name: rows[name] for name in chosen}


def from_blocks(fields: Sequence[Field], block: NDArray[np.uint8], *, n: int) -> Columns:
    """Return the columns of `n` records stored field by field, as PCD's binary_compressed keeps them.

    They are copies, so that the block need not be kept for the fields that nobody wants.
    """
    starts = np.cumsum([0, *(field.size * n for field in fields)])
    return {
        name: np.frombuffer(block, fields[i].dtype, count=n, offset=int(starts[i])).copy()
        for name, i in chosen_fields(fields).items()
    }


def header_line(head: bytes, start: int, *, last: str) -> tuple[list[str], int]:
    """Return the words of the header's line at `start`, and where the next one begins.

    Raises ScanError where `head` ends first, which names the `last` line that was waited for.
    """
    end = head.find(b"\n", start)
    if end < 0:
        raise ScanError(f"no {last} in the first {len(head)} bytes; the header is cut off or too long")
    return head[start:end].decode("latin-1").split(), end + 1


def text_lines(buffer: mmap.mmap, start: int) -> Iterator[bytes]:
    """Yield the lines of `buffer` from `start` on, without the blank ones; a block at a time is held.

    Raises ScanError for a line over the limit.
    """
    cut = b""  # the beginning of a line whose end is in the next block
    for at in range(start, len(buffer), LINE_LIMIT):
        *lines, last = buffer[at : at + LINE_LIMIT].split(b"\n")
        if lines:
            lines[0], cut = cut + lines[0], last
            _check_line(lines[0])
            yield from (line for line in lines if line and not line.isspace())
        else:
            cut += last
        _check_line(cut)
    if cut and not cut.isspace():
        yield cut


def _check_line(line: bytes) -> None:
    if len(line) > LINE_LIMIT:
        raise ScanError(f"a line of over {LINE_LIMIT} bytes; write one point a line")


def from_text(fields: Sequence[Field], lines: Iterator[bytes], *, n: int, size: int) -> Columns:
    """Return the columns of `n` lines of numbers; `size` is how many bytes are left in the file.

    Raises ScanError for a missing line, a wrong number of columns, a word, or a value outside its type.
    """
    width = sum(field.count for field in fields)
    if n * width * 2 - 1 > size:  # a number takes a digit and a separator
        raise ScanError(
            f"truncated: header declares {n} points of {width} numbers, file holds {size} bytes of them"
        )
    firsts = np.cumsum([0, *(field.count for field in fields)])
    chosen = chosen_fields(fields)
    columns = {name: np.empty(n, fields[i].dtype) for name, i in chosen.items()}
    start = 0
    while start < n:
        chunk = _chunk(lines, rows=min(n - start, max(1, _NUMBERS_AT_ONCE // width)))
        if not chunk:
            raise ScanError(
                f"the file is cut off (truncated): header declares {n} points, file holds {start}; copy or record it again"
            )
        numbers = _decode(chunk, width, start=start, n=n)
        for name, i in chosen.items():
            columns[name][start : start + len(chunk)] = _cast(numbers[:, firsts[i]], fields[i])
        start += len(chunk)
    return columns


def _chunk(lines: Iterator[bytes], *, rows: int) -> list[bytes]:
    """Take up to so many lines, and fewer where they are long."""
    chunk: list[bytes] = []
    held = 0
    while len(chunk) < rows and held < _TEXT_AT_ONCE:
        line = next(lines, None)
        if line is None:
            break
        chunk.append(line)
        held += len(line)
    return chunk


def _decode(chunk: list[bytes], width: int, *, start: int, n: int) -> NDArray[np.float64]:
    """Decode lines of `width` numbers, (lines, width); raise ScanError that names the point at fault."""
    try:
        numbers = np.loadtxt(chunk, dtype=np.float64, comments=None, ndmin=2, encoding="latin-1")
    except ValueError:
        numbers = np.empty((0, 0))
    if numbers.shape == (len(chunk), width):
        return numbers
    for row, line in enumerate(chunk, start=start + 1):
        words = line.decode("latin-1").split()
        if len(words) != width:
            raise ScanError(
                f"truncated or broken: point {row} of {n} has {len(words)} numbers instead of {width}"
            )
        for word in words:
            if not _is_number(word):
                raise ScanError(f"point {row} of {n} has {word[:40]!r} where a number must stand")
    raise ScanError(f"points {start + 1} to {start + len(chunk)} of {n} are not lines of {width} numbers")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def _cast(values: NDArray[np.float64], field: Field) -> NDArray[Any]:
    """Cast numbers read as float64 to the type that the header declares for them."""
    if field.dtype.kind == "f":
        # Positions stay as read until they are checked; only a declared float may overflow here, to inf.
        with np.errstate(over="ignore"):
            return values.astype(field.dtype)
    limits = np.iinfo(field.dtype)
    bad = ~((values >= limits.min) & (values <= limits.max) & (values == np.rint(values)))
    if bad.any():
        value = values[np.argmax(bad)]
        raise ScanError(f"field {field.name!r} holds {value:g}, which no {field.dtype.name} can be")
    return values.astype(field.dtype)


def colors_of(columns: Columns) -> Colors | None:
    """Return the colours (N, 3) uint8 out of the columns, or None.

    A packed `rgb` is 0x00RRGGBB in four bytes, whatever type they are declared as (PCL, `PointXYZRGB`).
    Floating colours are scaled from 0..1; others are not guessed at.
    """
    for name in _PACKED:
        if name in columns:
            packed = np.ascontiguousarray(columns[name]).astype(
                columns[name].dtype.newbyteorder("="), copy=False
            )
            bits = packed.view(np.uint32)
            return np.stack([(bits >> shift & 0xFF).astype(np.uint8) for shift in (16, 8, 0)], axis=1)
    names = next((triple for triple in _TRIPLES if triple[0] in columns), None)
    if names is None:
        return None
    colors: NDArray[Any] = np.stack([columns[name] for name in names], axis=1)
    if colors.dtype == np.uint8:
        return colors.astype(np.uint8, copy=False)
    if not bool(np.all((colors >= 0) & (colors <= 1))):
        return None
    scaled: Colors = np.rint(colors * 255).astype(np.uint8)
    return scaled
