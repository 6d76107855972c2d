"""The header of PCD, versions .5 to .7: lines of text up to `DATA`.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from worker.errors import ScanError
from worker.pipeline.records import FARTHEST, Field
from worker.pipeline.values import Matrix4

_KEYWORDS = (
    "VERSION",
    "FIELDS",
    "COLUMNS",
    "SIZE",
    "TYPE",
    "COUNT",
    "WIDTH",
    "HEIGHT",
    "VIEWPOINT",
    "POINTS",
    "DATA",
)
_VERSIONS = (".5", ".6", ".7", "0.5", "0.6", "0.7")
_TYPES = {f"{kind}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}
_NO_POSE = ["0", "0", "0", "1", "0", "0", "0"]


@dataclass(frozen=True, kw_only=True, slots=True)
class PcdHeader:
    """What the header declares; nothing of it is trusted before it is held against the file's size."""

    fields: tuple[Field, ...]
    n: int  #: points
    encoding: str  #: ascii, binary or binary_compressed
    sensor_pose: Matrix4  #: (4, 4) float64, scan_from_sensor
    size: int  #: bytes of the header itself


def looks_like_pcd(head: bytes) -> bool:
    """Whether a file that starts with `head` means to be PCD."""
    return re.match(rb"\s*(#[^\n]*\.PCD|(VERSION|FIELDS|COLUMNS)\s)", head) is not None


def parse_pcd_header(head: bytes) -> PcdHeader:
    """Read the header out of a file's first bytes. Raises ScanError."""
    entries, size = _entries(head)
    names = entries.get("FIELDS") or entries.get("COLUMNS")
    if not names:
        raise ScanError("header has no FIELDS; write a PCD header of version 0.7")
    version = " ".join(entries.get("VERSION", [".7"]))
    if version not in _VERSIONS:
        raise ScanError(f"PCD version {version[:40]!r} is none of .5 .6 .7")
    encoding = " ".join(entries["DATA"])
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise ScanError(f"DATA {encoding[:40]!r} is none of ascii, binary, binary_compressed")
    return PcdHeader(
        fields=_fields(names, entries),
        n=_n_points(entries),
        encoding=encoding,
        sensor_pose=_viewpoint(entries.get("VIEWPOINT", _NO_POSE)),
        size=size,
    )


def _entries(head: bytes) -> tuple[dict[str, list[str]], int]:
    """The header's lines by keyword, and how many bytes they take."""
    entries: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in entries:
        end = head.find(b"\n", position)
        if end < 0:
            raise ScanError(f"no DATA line in the first {len(head)} bytes; the header is cut off or too long")
        words = head[position:end].decode("latin-1").split()
        position = end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYWORDS or words[0] in entries:
            raise ScanError(f"header line {words[0][:40]!r} is unknown or stands twice")
        entries[words[0]] = words[1:]
    return entries, position


def _fields(names: list[str], entries: dict[str, list[str]]) -> tuple[Field, ...]:
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(types) == len(counts):
        found = f"{len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE, {len(counts)} COUNT"
        raise ScanError(f"header lines disagree: {found}")
    fields = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if kind + size not in _TYPES:
            raise ScanError(
                f"field {name[:40]!r} has TYPE {kind[:8]} SIZE {size[:8]}, which PCD does not know"
            )
        fields.append(
            Field(name=name, dtype=np.dtype(f"<{kind.lower()}{size}"), count=_number(count, "COUNT"))
        )
    return tuple(fields)


def _n_points(entries: dict[str, list[str]]) -> int:
    declared = {
        key: _number(" ".join(entries[key]), key) for key in ("WIDTH", "HEIGHT", "POINTS") if key in entries
    }
    if "WIDTH" not in declared:
        if "POINTS" not in declared:
            raise ScanError("header has neither WIDTH nor POINTS")
        return declared["POINTS"]
    width, height = declared["WIDTH"], declared.get("HEIGHT", 1)
    points = declared.get("POINTS", width * height)
    if points != width * height:
        raise ScanError(f"header declares POINTS {points}, but WIDTH x HEIGHT is {width} x {height}")
    return points


def _number(word: str, key: str) -> int:
    if re.fullmatch("[0-9]{1,18}", word) is None:
        raise ScanError(f"{key} {word[:40]!r} is not a whole number")
    return int(word)


def _viewpoint(words: list[str]) -> Matrix4:
    """`tx ty tz qw qx qy qz` as scan_from_sensor."""
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (7,) or not bool(np.all(np.abs(numbers) < FARTHEST)):
        raise ScanError(
            f"VIEWPOINT {' '.join(words)[:80]!r} is not tx ty tz qw qx qy qz in metres, within {FARTHEST:g} m"
        )
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1) > 0.05:
        raise ScanError(
            f"VIEWPOINT's quaternion has length {length:.3g}, not 1; without a pose write 1 0 0 0"
        )
    w, x, y, z = numbers[3:] / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = numbers[:3]
    return pose
