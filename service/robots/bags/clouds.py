"""sensor_msgs/PointCloud2 as PCD: the same numbers, without the gaps between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

#: sensor_msgs/PointField: datatype -> TYPE and SIZE of PCD.
_TYPES = {
    1: ("I", 1),
    2: ("U", 1),
    3: ("I", 2),
    4: ("U", 2),
    5: ("I", 4),
    6: ("U", 4),
    7: ("F", 4),
    8: ("F", 8),
}
_KEPT = ("x", "y", "z", "intensity", "rgb")


class CloudError(Exception):
    """A cloud that is none; `str()` says what is wrong."""


@dataclass(frozen=True, slots=True)
class Column:
    """One field of each point."""

    name: str
    kind: str  #: F, I or U
    size: int  #: bytes


@dataclass(frozen=True, slots=True)
class Cloud:
    """The points of one message in the sensor's axes, metres."""

    columns: tuple[Column, ...]
    data: bytes  #: little-endian, point after point
    count: int


def cloud_of(message: Any) -> Cloud:
    """Return x, y, z, and intensity and colour where there are, of a PointCloud2. Raises CloudError."""
    fields = {
        field.name: field for field in message.fields if field.count in (0, 1) and field.datatype in _TYPES
    }
    missing = [name for name in "xyz" if name not in fields or _TYPES[fields[name].datatype][0] != "F"]
    if missing:
        there = ", ".join(field.name for field in message.fields) or "none"
        raise CloudError(f"the cloud has no {', '.join(missing)} in floating point; its fields are {there}")
    kept = [fields[name] for name in _KEPT if name in fields]
    columns = tuple(Column(field.name, *_TYPES[field.datatype]) for field in kept)
    raw, count = _rows(message), message.width * message.height
    stride = sum(column.size for column in columns)
    packed, at = bytearray(stride * count), 0
    for field, column in zip(kept, columns, strict=True):
        for byte in range(column.size):
            of_field = column.size - 1 - byte if message.is_bigendian else byte
            packed[at + byte :: stride] = raw[field.offset + of_field :: message.point_step]
        at += column.size
    return Cloud(columns, bytes(packed), count)


def pcd_of(clouds: Sequence[Cloud]) -> bytes:
    """Return clouds of one sensor, which did not move meanwhile, as one binary PCD 0.7."""
    columns = clouds[0].columns
    alike = [cloud for cloud in clouds if cloud.columns == columns]
    count = sum(cloud.count for cloud in alike)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(column.name for column in columns)}\n"
        f"SIZE {' '.join(str(column.size) for column in columns)}\n"
        f"TYPE {' '.join(column.kind for column in columns)}\n"
        f"COUNT {' '.join('1' for _ in columns)}\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    return header.encode() + b"".join(cloud.data for cloud in alike)


def _rows(message: Any) -> bytes:
    """Return the points without what is between the rows. Raises CloudError where bytes are missing."""
    row = message.width * message.point_step
    data = bytes(message.data)
    if message.row_step < row or len(data) < message.row_step * message.height:
        raise CloudError(
            f"{len(data)} bytes for {message.height} rows of {message.width} points of {message.point_step} bytes"
        )
    if message.row_step == row:
        return data[: row * message.height]
    return b"".join(
        data[start : start + row] for start in range(0, message.row_step * message.height, message.row_step)
    )
