"""Sound files of E57, LAS and LAZ, written by other people's libraries, with known points."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pye57
from pye57 import libe57
from scipy.spatial.transform import Rotation


def write_e57(
    path: Path,
    stations: Sequence[np.ndarray],
    *,
    poses: Sequence[np.ndarray | None] | None = None,
    colors: Sequence[np.ndarray] | None = None,
    invalid: np.ndarray | None = None,
    names: Sequence[str] | None = None,
) -> Path:
    """Write scans (N, 3) of stations, each in its own frame, with file_from_station (4, 4)."""
    path.unlink(missing_ok=True)
    with pye57.E57(str(path), "w") as file:
        for index, points in enumerate(stations):
            data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T.astype("d"), strict=True))
            if colors is not None:
                red_green_blue = colors[index].T.astype(np.uint8)
                data |= dict(zip(("colorRed", "colorGreen", "colorBlue"), red_green_blue, strict=True))
            if invalid is not None:
                data["cartesianInvalidState"] = invalid.astype("b")
            pose = None if poses is None else poses[index]
            known: dict[str, Any] = {}
            if pose is not None:
                x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
                known = {"rotation": np.array([w, x, y, z]), "translation": pose[:3, 3]}
            name = f"station {index + 1}" if names is None else names[index]
            file.write_scan_raw(data, name=name, **known)
    return path


def damage_station(path: Path, number: int) -> None:
    """Change a byte of the points of one station, so that the checksum of its page does not hold."""
    content = bytearray(path.read_bytes())
    _, xml = split_xml(bytes(content))
    offsets = [int(word) for word in re.findall(rb'<points [^>]*fileOffset="(\d+)"', xml)]
    content[offsets[number] + 2048] ^= 0xFF  # not on the page of the header
    path.write_bytes(content)


def write_e57_nodes(path: Path, fields: dict[str, tuple[Any, np.ndarray]], extra: Any = None) -> Path:
    """Write one scan whose prototype is given: a maker of each node by field, and its values as they are stored."""
    path.unlink(missing_ok=True)
    with pye57.E57(str(path), "w") as file:
        image = file.image_file
        scan, prototype = libe57.StructureNode(image), libe57.StructureNode(image)
        scan.set("guid", libe57.StringNode(image, "{one}"))
        if extra is not None:
            extra(image, scan)
        buffers = libe57.VectorSourceDestBuffer()
        kept = []
        for name, (make, values) in fields.items():
            prototype.set(name, make(image))
            kept.append(np.ascontiguousarray(values))
            buffers.append(libe57.SourceDestBuffer(image, name, kept[-1], len(values), True, True))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        scan.set("points", points)
        file.data3d.append(scan)
        writer = points.writer(buffers)
        writer.write(len(kept[0]))
        writer.close()
    return path


def write_las(
    path: Path,
    points: np.ndarray,
    *,
    point_format: int = 3,
    version: str | None = None,
    colors: np.ndarray | None = None,
    scale: float = 0.001,
    withheld: np.ndarray | None = None,
    extra: int = 0,
) -> Path:
    """Write points (N, 3); the ending of `path` says whether they are packed. `colors` (N, 3) uint16 as they stand."""
    usual = "1.4" if point_format > 5 else "1.3" if point_format in (4, 5) else "1.2"
    header = laspy.LasHeader(point_format=point_format, version=version or usual)
    header.scales, header.offsets = np.full(3, scale), np.floor(points.min(axis=0))
    if extra:
        header.add_extra_dims([laspy.ExtraBytesParams(f"extra_{n}", "f8") for n in range(extra)])
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    if colors is not None:
        las.red, las.green, las.blue = colors.T
    if withheld is not None:
        las.withheld = withheld
    las.write(str(path))
    return path


_CRC = [0] * 256
for _byte in range(256):
    _value = _byte
    for _ in range(8):
        _value = _value >> 1 ^ (0x82F63B78 if _value & 1 else 0)
    _CRC[_byte] = _value


def crc32c(data: bytes) -> int:
    """Return the CRC-32C (Castagnoli) that each page of an E57 has at its end."""
    value = 0xFFFFFFFF
    for byte in data:
        value = _CRC[(value ^ byte) & 0xFF] ^ value >> 8
    return value ^ 0xFFFFFFFF


def without_checksums(content: bytes) -> bytes:
    """Return what the pages of an E57 hold."""
    return b"".join(content[start : start + 1020] for start in range(0, len(content), 1024))


def with_checksums(plain: bytes) -> bytes:
    """Return the pages that hold these bytes."""
    pages = (plain[start : start + 1020].ljust(1020, b"\0") for start in range(0, len(plain), 1020))
    return b"".join(page + struct.pack(">I", crc32c(page)) for page in pages)


def split_xml(content: bytes) -> tuple[bytes, bytes]:
    """Return what the pages of an E57 hold before its XML, and the XML."""
    at, length = struct.unpack_from("<QQ", content, 24)
    plain, begin = without_checksums(content), at // 1024 * 1020 + at % 1024
    return plain[:begin], plain[begin : begin + length]


def with_xml(before: bytes, xml: bytes) -> bytes:
    """Return an E57 of what stands before its XML, and the XML on pages of its own; every checksum holds."""
    plain = before.ljust(-(-len(before) // 1020) * 1020, b"\0")
    place = len(plain) // 1020 * 1024
    whole = plain + xml.ljust(-(-max(len(xml), 1) // 1020) * 1020)
    header = struct.pack("<QQQ", len(whole) // 1020 * 1024, place, len(xml))
    return with_checksums(whole[:16] + header + whole[40:])
