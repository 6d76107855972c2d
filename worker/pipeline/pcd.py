"""PCD, the format of the Point Cloud Library, read in all its encodings and written in binary.

`binary_compressed` holds two uint32 (compressed and plain size), then one LZF block in which the fields stand
one after another (PCL, `pcl/io/pcd_io.h`).
"""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worker.errors import ScanError, ScanTooLarge
from worker.pipeline.pcd_header import PcdHeader, parse_pcd_header
from worker.pipeline.records import (
    HEADER_LIMIT,
    Columns,
    RawCloud,
    chosen_fields,
    from_blocks,
    from_rows,
    stride,
)
from worker.pipeline.text_rows import from_text, text_lines
from worker.pipeline.values import Colors, Matrix4, Points

_LZF_GAIN = 88  #: the longest back reference of LZF makes 264 bytes out of 3


def read_pcd(buffer: mmap.mmap, *, max_points: int) -> RawCloud:
    """Decode a whole PCD file. Raises ScanError, ScanTooLarge."""
    header = parse_pcd_header(buffer[:HEADER_LIMIT])
    chosen_fields(header.fields)
    if header.n > max_points:
        raise ScanTooLarge(
            f"header declares {header.n} points, the limit is {max_points}; split or thin the scan"
        )
    if header.encoding == "ascii":
        columns = _ascii(header, buffer)
    elif header.encoding == "binary":
        columns = _binary(header, buffer)
    else:
        columns = _compressed(header, buffer)
    return RawCloud(columns=columns, sensor_pose=header.sensor_pose)


def _ascii(header: PcdHeader, buffer: mmap.mmap) -> Columns:
    buffer.seek(header.size)
    lines = text_lines(buffer)
    columns = from_text(header.fields, lines, n=header.n, size=len(buffer) - header.size)
    if next(lines, None) is not None:
        raise ScanError(f"header declares {header.n} points, but more lines follow; correct POINTS")
    return columns


def _binary(header: PcdHeader, buffer: mmap.mmap) -> Columns:
    width, held = stride(header.fields), len(buffer) - header.size
    needed = header.n * width
    if held < needed:
        raise ScanError(
            f"truncated: header declares {header.n} points ({needed} bytes), "
            f"file holds {held // width} ({held} bytes); upload it again"
        )
    _refuse_leftovers(buffer, header.size + needed)
    return from_rows(header.fields, buffer, offset=header.size, n=header.n)


def _compressed(header: PcdHeader, buffer: mmap.mmap) -> Columns:
    start, needed = header.size + 8, header.n * stride(header.fields)
    if len(buffer) < start:
        raise ScanError(
            f"truncated: header declares {header.n} points, the file ends before the compressed data"
        )
    packed, plain = (int(v) for v in np.frombuffer(buffer, "<u4", count=2, offset=header.size))
    if len(buffer) - start < packed:
        raise ScanError(
            f"truncated: {packed} bytes of compressed data for {header.n} points are declared, "
            f"file holds {len(buffer) - start}; upload it again"
        )
    if plain != needed or plain > packed * _LZF_GAIN:
        raise ScanError(
            f"{packed} compressed bytes are said to hold {plain}, but {header.n} points take {needed} bytes"
        )
    _refuse_leftovers(buffer, start + packed)
    return from_blocks(header.fields, _decompress(buffer[start : start + packed], plain), n=header.n)


def _decompress(packed: bytes, size: int) -> NDArray[np.uint8]:
    import imagecodecs  # noqa: PLC0415 - most scans are not compressed

    plain = np.empty(size, np.uint8)
    if size == 0:
        return plain
    try:
        filled = len(imagecodecs.lzf_decode(packed, out=plain.data))
    except imagecodecs.LzfError as error:
        raise ScanError(f"compressed data is damaged ({error}); upload it again") from None
    if filled != size:  # the decoder stops early without complaint
        raise ScanError(f"compressed data is damaged: it gives {filled} bytes instead of {size}")
    return plain


def _refuse_leftovers(buffer: mmap.mmap, end: int) -> None:
    """Old PCL pads the file to a page with zeros; anything else after the points means a wrong header."""
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
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(name for name, _ in fields)}\n"
        f"SIZE {' '.join(kind[2] for _, kind in fields)}\n"
        f"TYPE {' '.join(kind[1].upper() for _, kind in fields)}\n"
        f"COUNT {' '.join('1' for _ in fields)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {_viewpoint(np.eye(4) if sensor_pose is None else sensor_pose)}\n"
        f"POINTS {len(rows)}\nDATA binary\n"
    )
    aside = path.with_name(path.name + ".tmp")
    with aside.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())
    aside.replace(path)


def _viewpoint(pose: Matrix4) -> str:
    """`tx ty tz qw qx qy qz` of a rigid pose."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - reading does not need it

    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return " ".join(f"{value:.9g}" for value in (*pose[:3, 3], w, x, y, z))
