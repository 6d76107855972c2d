"""The header of PLY, version 1.0: which tables follow, and how a row of each is laid out.

Format: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from worker.errors import ScanError
from worker.pipeline.records import Field

SHORT_NAMES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
}  # fmt: skip
_LONG_NAMES = {
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_TYPES = SHORT_NAMES | _LONG_NAMES
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


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
    """Whether a file that starts with `head` means to be PLY."""
    return re.match(rb"ply[ \t]*\r?\n", head) is not None


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
    """The words of each line between `ply` and `end_header`, comments left out, and the header's bytes."""
    lines: list[list[str]] = []
    position = head.find(b"\n") + 1
    while True:
        end = head.find(b"\n", position)
        if end < 0:
            raise ScanError(
                f"no end_header in the first {len(head)} bytes; the header is cut off or too long"
            )
        words = head[position:end].decode("latin-1").split()
        position = end + 1
        if words == ["end_header"]:
            return lines, position
        if words and words[0] not in ("comment", "obj_info"):
            lines.append(words)


def _format(words: list[str]) -> str:
    match words:
        case ["format", encoding, "1.0"] if encoding in _ORDERS:
            return encoding
    raise ScanError(f"second header line {' '.join(words)[:80]!r} is not a known 'format ... 1.0'")


def _property(words: list[str], order: str) -> Property:
    match words:
        case ["list", length, kind, name] if _TYPES.get(length, "f")[0] != "f" and kind in _TYPES:
            field = Field(name=name, dtype=np.dtype(order + _TYPES[kind]))
            return Property(field=field, length=np.dtype(order + _TYPES[length]))
        case [kind, name] if kind in _TYPES:
            return Property(field=Field(name=name, dtype=np.dtype(order + _TYPES[kind])), length=None)
    raise ScanError(f"property {' '.join(words)[:80]!r} has a type that PLY does not know")
