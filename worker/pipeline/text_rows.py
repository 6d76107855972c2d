"""Text rows: points written as lines of numbers, the same in ASCII PCD and ASCII PLY."""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.errors import ScanError
from worker.pipeline.records import Columns, Field, chosen_fields

LINE_LIMIT = 1024 * 1024  #: bytes of one line
_NUMBERS_AT_ONCE = 1_000_000  #: decoded together, which bounds the memory of the columns nobody wants


def from_text(fields: Sequence[Field], lines: Iterator[bytes], *, n: int, size: int) -> Columns:
    """Columns of `n` lines of numbers; `size` is how many bytes are left in the file.

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
    step = max(1, _NUMBERS_AT_ONCE // width)
    for start in range(0, n, step):
        rows = min(step, n - start)
        chunk = list(islice(lines, rows))
        numbers = _decode(chunk, width, start=start, n=n)
        for name, i in chosen.items():
            columns[name][start : start + len(chunk)] = _cast(numbers[:, firsts[i]], fields[i])
        if len(chunk) < rows:
            raise ScanError(
                f"truncated: header declares {n} points, file holds {start + len(chunk)}; upload it again"
            )
    return columns


def text_lines(buffer: mmap.mmap) -> Iterator[bytes]:
    """Lines of `buffer` from where it stands, without the blank ones."""
    for line in iter(buffer.readline, b""):
        if len(line) > LINE_LIMIT:
            raise ScanError(f"a line of {len(line)} bytes, the limit is {LINE_LIMIT}; write one point a line")
        if not line.isspace():
            yield line


def _decode(chunk: list[bytes], width: int, *, start: int, n: int) -> NDArray[np.float64]:
    if not chunk:
        return np.empty((0, width))
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
    """Numbers read as float64 in the type that the header declares for them."""
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
