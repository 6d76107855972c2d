"""Records: how one point lies in a file, and its positions and colours taken out of it.

PCD and PLY both describe a point as a row of named, typed fields. Both readers turn their header into
`Field`s; from there on the two formats are the same.
"""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.errors import ScanError
from worker.pipeline.values import Colors, Matrix4

FARTHEST = 10_000.0  #: metres from the origin; there a float32 steps by 1 mm

HEADER_LIMIT = 64 * 1024  #: bytes; a longer header is refused unread
STRIDE_LIMIT = 64 * 1024  #: bytes of one point; SHOT, the widest descriptor in PCL, takes 1.4 kB

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


def stride(fields: Sequence[Field]) -> int:
    """Bytes of one point."""
    return sum(field.size for field in fields)


def chosen_fields(fields: Sequence[Field]) -> dict[str, int]:
    """The fields that are read, name to index; the others are skipped over.

    Raises ScanError when x, y or z is missing, doubled, or not one float or double, or a point is too wide.
    """
    if stride(fields) > STRIDE_LIMIT:
        raise ScanError(
            f"a point takes {stride(fields)} bytes, the limit is {STRIDE_LIMIT}; drop wide fields"
        )
    names = [field.name for field in fields]
    for name in _POSITION:
        if names.count(name) != 1:
            raise ScanError(
                f"{names.count(name)} fields are named {name!r}, one is needed; write x, y and z once"
            )
        field = fields[names.index(name)]
        if field.count != 1 or field.dtype.kind != "f":
            # Integers are some writer's private scale: reading them as metres would be a guess.
            kind = f"{field.count} x {field.dtype.name}"
            raise ScanError(f"field {name!r} is {kind}; write positions as one float or double in metres")
    return {name: names.index(name) for name in (*_POSITION, *_color_names(fields))}


def _color_names(fields: Sequence[Field]) -> tuple[str, ...]:
    """The fields that colour a point, or none; a colour in any other type is ignored as any other field is."""
    single = {f.name: f for f in fields if f.count == 1 and [g.name for g in fields].count(f.name) == 1}
    for triple in _TRIPLES:
        if all(name in single for name in triple):
            kinds = {single[name].dtype.newbyteorder("=").str[1:] for name in triple}
            return triple if len(kinds) == 1 and kinds <= {"u1", "f4", "f8"} else ()
    return next(((name,) for name in _PACKED if name in single and single[name].dtype.itemsize == 4), ())


def colors_of(columns: Columns) -> Colors | None:
    """Colours (N, 3) uint8 out of the columns, or None.

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


def from_rows(fields: Sequence[Field], buffer: mmap.mmap, *, offset: int, n: int) -> Columns:
    """Columns of `n` records that lie one after another; the caller has checked that they are there."""
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
    """Columns of `n` records stored field by field, as PCD's binary_compressed keeps them."""
    starts = np.cumsum([0, *(field.size * n for field in fields)])
    return {
        name: np.frombuffer(block, fields[i].dtype, count=n, offset=int(starts[i]))
        for name, i in chosen_fields(fields).items()
    }
