"""PCD files, versions .5 to .7: a header in lines of text up to `DATA`, then the points.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import mmap
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from worker.cloud.formats.fields import (
    FARTHEST,
    HEADER_LIMIT,
    Columns,
    Field,
    RawCloud,
    check_point_count,
    chosen_fields,
    from_blocks,
    from_rows,
    from_text,
    header_line,
    rows_size,
    stride,
    text_lines,
)
from worker.cloud.types import Colors, Matrix4, Points
from worker.errors import ScanError, ScanTooLarge
from worker.files import write_bytes

_KEYWORDS = (
    "VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA",
)  # fmt: skip
_VERSIONS = (".5", ".6", ".7", "0.5", "0.6", "0.7")
_TYPES = {f"{kind}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}
_NO_POSE = ["0", "0", "0", "1", "0", "0", "0"]
_LZF_GAIN = 88  #: the longest back reference of LZF makes 264 bytes out of 3
_LZF_HONEST_GAIN = (
    32  #: of a block that is not harmless; measured coordinates hardly pack, fields of zeros do
)
_HARMLESS = 64 * 1024**2  #: bytes that may be unpacked whatever the gain and the limit of points
_PLAIN_PER_POINT = 24  #: bytes a point of the limit: positions, colours, and twice as much that is not used
_PLAIN_LIMIT = 2**31 - 1  #: bytes that `lzf_decode` can unpack


@dataclass(frozen=True, kw_only=True, slots=True)
class PcdHeader:
    """What the header declares; nothing of it is trusted before it is held against the file's size."""

    fields: tuple[Field, ...]
    n: int  #: points
    encoding: str  #: ascii, binary or binary_compressed
    sensor_pose: Matrix4  #: (4, 4) float64, scan_from_sensor
    size: int  #: bytes of the header itself


def looks_like_pcd(head: bytes) -> bool:
    """Tell whether a file that starts with `head` means to be PCD."""
    return re.match(rb"\s*(#[^\n]*\.PCD|(VERSION|FIELDS|COLUMNS)\s)", head) is not None


def read_pcd(buffer: mmap.mmap, *, max_points: int) -> RawCloud:
    """Decode a whole PCD file. Raises ScanError, ScanTooLarge."""
    header = parse_pcd_header(buffer[:HEADER_LIMIT])
    chosen_fields(header.fields)
    check_point_count(header.n, max_points=max_points)
    if header.encoding == "binary_compressed":
        columns = _compressed(header, buffer, most=max(_PLAIN_PER_POINT * max_points, _HARMLESS))
    else:
        columns = {"ascii": _ascii, "binary": _binary}[header.encoding](header, buffer)
    return RawCloud(columns=columns, sensor_pose=header.sensor_pose)


def _check_plain_size(size: int, packed: int, *, most: int) -> None:
    """Refuse a block that would unpack to more than it is worth: LZF can only be unpacked whole."""
    most = min(most, _PLAIN_LIMIT)
    if size > most:
        raise ScanTooLarge(
            f"the compressed points unpack to {size} bytes, the limit is {most}; "
            "write them without compression, or leave out fields"
        )
    if size > max(packed * _LZF_HONEST_GAIN, _HARMLESS):
        raise ScanError(
            f"{packed} compressed bytes unpack to {size}, as no scan's do; write them without compression"
        )


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
    """Return the words of the header's lines by keyword, and how many bytes the header takes."""
    entries: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in entries:
        words, position = header_line(head, position, last="DATA line")
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYWORDS or words[0] in entries:
            raise ScanError(f"header line {words[0][:40]!r} is unknown or stands twice")
        entries[words[0]] = words[1:]
    return entries, position


def _fields(names: list[str], entries: dict[str, list[str]]) -> tuple[Field, ...]:
    """Pair the names with their entries of SIZE, TYPE and COUNT."""
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(types) == len(counts):
        lengths = f"{len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE, {len(counts)} COUNT"
        raise ScanError(f"header lines disagree: {lengths}")
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
    """Return the number of points that WIDTH, HEIGHT and POINTS agree on."""
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
    """Return scan_from_sensor (4, 4) of `tx ty tz qw qx qy qz`, metres and a unit quaternion."""
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
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.roll(numbers[3:], -1)).as_matrix()  # SciPy writes x y z w
    pose[:3, 3] = numbers[:3]
    return pose


def _ascii(header: PcdHeader, buffer: mmap.mmap) -> Columns:
    lines = text_lines(buffer, header.size)
    columns = from_text(header.fields, lines, n=header.n, size=len(buffer) - header.size)
    if next(lines, None) is not None:
        raise ScanError(f"header declares {header.n} points, but more lines follow; correct POINTS")
    return columns


def _binary(header: PcdHeader, buffer: mmap.mmap) -> Columns:
    needed = rows_size(header.fields, n=header.n, held=len(buffer) - header.size)
    _refuse_leftovers(buffer, header.size + needed)
    return from_rows(header.fields, buffer, offset=header.size, n=header.n)


def _compressed(header: PcdHeader, buffer: mmap.mmap, *, most: int) -> Columns:
    start, needed = header.size + 8, header.n * stride(header.fields)
    if len(buffer) < start:
        raise ScanError(
            f"truncated: header declares {header.n} points, the file ends before the compressed data"
        )
    packed, unpacked = (int(v) for v in np.frombuffer(buffer, "<u4", count=2, offset=header.size))
    if len(buffer) - start < packed:
        raise ScanError(
            f"truncated: {packed} bytes of compressed data for {header.n} points are declared, "
            f"file holds {len(buffer) - start}; copy or record it again"
        )
    if unpacked != needed or unpacked > packed * _LZF_GAIN:
        raise ScanError(
            f"{packed} compressed bytes are said to hold {unpacked}, but {header.n} points take {needed} bytes"
        )
    _check_plain_size(unpacked, packed, most=most)
    _refuse_leftovers(buffer, start + packed)
    block = memoryview(buffer)[start : start + packed]
    return from_blocks(header.fields, _decompress(block, unpacked), n=header.n)


def _decompress(packed: memoryview, size: int) -> NDArray[np.uint8]:
    """Unpack an LZF block into exactly `size` bytes."""
    import imagecodecs  # noqa: PLC0415 - most scans are not compressed

    unpacked = np.empty(size, np.uint8)
    if size == 0:
        return unpacked
    try:
        filled = len(imagecodecs.lzf_decode(packed, out=unpacked.data))  # type: ignore[arg-type]  # any buffer
    except imagecodecs.LzfError as error:
        raise ScanError(f"compressed data is damaged ({error}); copy or record it again") from None
    if filled != size:  # the decoder stops early without complaint
        raise ScanError(f"compressed data is damaged: it gives {filled} bytes instead of {size}")
    return unpacked


def _refuse_leftovers(buffer: mmap.mmap, end: int) -> None:
    """Raise ScanError for anything after the points but zeros, with which old PCL pads the file to a page."""
    left = len(buffer) - end
    if left and np.frombuffer(buffer, np.uint8, offset=end).any():
        raise ScanError(f"{left} bytes follow after the declared points; correct POINTS or the fields")


def write_pcd(
    path: Path, points: Points, *, colors: Colors | None = None, sensor_pose: Matrix4 | None = None
) -> None:
    """Write binary PCD 0.7: float32 x y z, with colours a packed U4 `rgb`, and `sensor_pose` as VIEWPOINT.

    `sensor_pose` is scan_from_sensor, rigid. The file appears whole or not at all.
    """
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")] + ([] if colors is None else [("rgb", "<u4")])
    rows = np.empty(len(points), np.dtype(fields))
    rows["x"], rows["y"], rows["z"] = np.asarray(points, np.float32).T
    if colors is not None:
        red, green, blue = np.asarray(colors, np.uint32).T
        rows["rgb"] = red << 16 | green << 8 | blue
    viewpoint = _viewpoint_words(np.eye(4) if sensor_pose is None else sensor_pose)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(name for name, _ in fields)}\n"
        f"SIZE {' '.join(kind[2] for _, kind in fields)}\n"
        f"TYPE {' '.join(kind[1].upper() for _, kind in fields)}\n"
        f"COUNT {' '.join('1' for _ in fields)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\n"
        f"POINTS {len(rows)}\nDATA binary\n"
    )
    write_bytes(path, header.encode("ascii"), rows.tobytes())


def _viewpoint_words(pose: Matrix4) -> str:
    """Return `tx ty tz qw qx qy qz` of a rigid pose (4, 4)."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return " ".join(f"{value:.9g}" for value in (*pose[:3, 3], w, x, y, z))
