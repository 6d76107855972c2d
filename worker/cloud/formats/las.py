"""LAS 1.0 to 1.4 and LAZ: a header of numbers, records of variable length, then points of one of the formats 0 to 10.

Formats: ASPRS, "LAS Specification 1.4 - R15", 2019; Isenburg, "LASzip: lossless compression of LiDAR data", 2013. A COPC
file is a LAZ whose records also hold an octree, and is read like any other. Records of points are taken apart here;
lazrs unpacks those of a LAZ.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.fields import check_point_count
from worker.cloud.formats.store import ColumnStore
from worker.cloud.types import Floats
from worker.errors import ScanError, ScanTooLarge

_HEADER_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}  #: bytes at least, by minor version
_RECORD_SIZES = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
_COLORS_AT = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}  #: bytes before red, green, blue, each uint16
_FORMAT_AT = (
    104  #: byte of the header that names the point format; its highest two bits say that it is packed
)
_LEAST_SCALE, _MOST_SCALE = 1e-9, 1.0  #: metres; a step wider than a metre is no measurement
_MOST_RECORDS = 10_000  #: of variable length
_RECORD_HEADER = struct.Struct("<2x16sHH32x")  #: user id, record id, length
_LASZIP = (b"laszip encoded", 22204)
_ANY_SIZE = 2**32 - 1  #: points of a chunk where chunks differ, as in COPC
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  #: of a chunk, by kind of item: point, colour, infrared, wave
_BYTES = 14  #: the kind of extra bytes, a layer each
_LAYERED = 3  #: the compressor of formats 6 to 10
_AT_ONCE = 64 * 1024**2  #: bytes of points that are held together
_POINTS_AT_ONCE = 1_000_000
_PLAIN_PER_POINT = 100  #: bytes a point of the limit that a LAZ may unpack to; format 10 takes 67
_HONEST_GAIN = 32  #: of the 20 bytes that each point has at least; measured points pack to a fifth
_HARMLESS = 64 * 1024**2  #: bytes that may be unpacked whatever the gain


@dataclass(frozen=True, kw_only=True, slots=True)
class LasHeader:
    """What the header declares, held against the file's size."""

    point_format: int  #: 0 to 10
    record_size: int  #: bytes of a point
    n: int  #: points
    start: int  #: byte of the first point
    scales: Floats  #: (3,) metres a step
    offsets: Floats  #: (3,) metres
    laszip: bytes | None  #: how the points are packed; None: they are not


def looks_like_las(head: bytes) -> bool:
    """Tell whether a file that starts with `head` means to be LAS or LAZ."""
    return head.startswith(b"LASF")


def read_las(file: BinaryIO, store: ColumnStore, *, max_points: int) -> None:
    """Decode all points of an open file into `store`: x, y, z in the coordinates of the file; withheld ones are NaN.

    Raises ScanError, ScanTooLarge; whatever lazrs does to a damaged LAZ ends the process.
    """
    buffer = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    header = parse_las_header(buffer)
    check_point_count(header.n, max_points=max_points)
    if header.laszip is None:
        pieces = _plain(header, buffer)
    else:
        _check_gain(header, len(buffer), max_points=max_points)
        if header.n:
            _check_chunk_table(header, header.laszip, buffer, file)
        pieces = _unpacked(header, header.laszip, file)
    store.allocate(header.n, colors=header.point_format in _COLORS_AT)
    brightest = done = 0
    for rows in pieces:
        piece = slice(done, done + len(rows))
        _put_positions(rows, header, store, piece)
        brightest = max(brightest, _put_colors(rows, header, store, piece))
        done += len(rows)
    store.finish_colors(brightest)


def parse_las_header(buffer: mmap.mmap) -> LasHeader:
    """Read the header. Raises ScanError."""
    if len(buffer) < _HEADER_SIZES[0]:
        raise ScanError(f"truncated: {len(buffer)} bytes, a LAS header takes {_HEADER_SIZES[0]}")
    major, minor = buffer[24], buffer[25]
    size, start, n_records, kind, record_size = struct.unpack_from("<HIIBH", buffer, 94)
    if major != 1 or minor not in _HEADER_SIZES:
        raise ScanError(f"LAS version {major}.{minor} is none of 1.0 to 1.4")
    if not _HEADER_SIZES[minor] <= size <= start:
        raise ScanError(
            f"the header says to take {size} bytes and its points to begin at byte {start}; version 1.{minor} takes "
            f"{_HEADER_SIZES[minor]} at least"
        )
    if start > len(buffer):
        raise ScanError(
            f"truncated: points begin at byte {start}, the file has {len(buffer)}; upload it again"
        )
    packed, point_format = bool(kind & 0xC0), kind & 0x3F
    if record_size < _RECORD_SIZES.get(point_format, 1 << 16):
        raise ScanError(f"a point of format {point_format} cannot take {record_size} bytes")
    scales = np.array(struct.unpack_from("<3d", buffer, 131))
    offsets = np.array(struct.unpack_from("<3d", buffer, 155))
    _check_scale(scales, offsets)
    laszip = _laszip_record(buffer, size, start, n_records)
    if packed != (laszip is not None):
        raise ScanError("the header and its records disagree on whether the points are packed (LAZ)")
    n = _n_points(buffer, minor)
    header = LasHeader(
        point_format=point_format,
        record_size=record_size,
        n=n,
        start=start,
        scales=scales,
        offsets=offsets,
        laszip=laszip,
    )
    if laszip is None:
        _check_size(header, buffer, minor)
    else:
        _check_laszip(header, laszip)
    return header


def _n_points(buffer: mmap.mmap, minor: int) -> int:
    """Return how many points the header declares; version 1.4 has a second, wider count."""
    legacy = int(struct.unpack_from("<I", buffer, 107)[0])
    if minor < 4:
        return legacy
    n = int(struct.unpack_from("<Q", buffer, 247)[0])
    if legacy not in (0, n):
        raise ScanError(f"the header declares {n} points, and in its older field {legacy}")
    return n


def _check_scale(scales: Floats, offsets: Floats) -> None:
    if not bool(np.all((scales >= _LEAST_SCALE) & (scales <= _MOST_SCALE))):
        raise ScanError(
            f"scale factors {_shown(scales)} are not steps in metres ({_LEAST_SCALE:g} to {_MOST_SCALE:g})"
        )
    if not bool(np.all(np.abs(offsets) < 1e9)):
        raise ScanError(f"offsets {_shown(offsets)} are not metres on this planet")


def _shown(numbers: Floats) -> str:
    return ", ".join(f"{value:g}" for value in numbers)


def _laszip_record(buffer: mmap.mmap, at: int, end: int, count: int) -> bytes | None:
    """Walk the records between the header and the points; return the one that says how points are packed."""
    if count > _MOST_RECORDS:
        raise ScanError(f"the header declares {count} records, at most {_MOST_RECORDS} are read")
    laszip = None
    for number in range(count):
        if at + _RECORD_HEADER.size > end:
            raise ScanError(f"record {number + 1} of {count} does not end before the points")
        user, record, length = _RECORD_HEADER.unpack_from(buffer, at)
        at += _RECORD_HEADER.size
        if at + length > end:
            raise ScanError(f"record {number + 1} of {count} has {length} bytes, {end - at} are left for it")
        if (user.split(b"\0")[0], record) == _LASZIP:
            laszip = buffer[at : at + length]
        at += length
    return laszip


def _check_size(header: LasHeader, buffer: mmap.mmap, minor: int) -> None:
    """Hold the declared points against the file's size; behind them only zeros and what the header tells of may be."""
    end = header.start + header.n * header.record_size
    if end > len(buffer):
        held = (len(buffer) - header.start) // header.record_size
        raise ScanError(
            f"truncated: header declares {header.n} points ({end - header.start} bytes), file holds {held}; "
            "upload it again"
        )
    told = (
        [int(struct.unpack_from("<Q", buffer, at)[0]) for at in ((227,), (227, 235))[minor == 4]]
        if minor > 2
        else []
    )
    if any(end <= start < len(buffer) for start in told):
        return
    left = len(buffer) - end
    if left and np.frombuffer(buffer, np.uint8, offset=end).any():
        raise ScanError(f"{left} bytes follow after the declared points; correct the count of points")


def _check_laszip(header: LasHeader, laszip: bytes) -> None:
    """Hold the record of LASzip against the header: what it unpacks to has to be a point."""
    if len(laszip) < 34:
        raise ScanError(f"the record of LASzip has {len(laszip)} bytes, it takes 34 at least")
    compressor, coder = struct.unpack_from("<HH", laszip)
    n_items = struct.unpack_from("<H", laszip, 32)[0]
    if compressor not in (2, 3) or coder != 0 or len(laszip) < 34 + 6 * n_items:
        raise ScanError(f"LASzip compressor {compressor}, coder {coder}, {n_items} items are not known")
    total = sum(size for _, size in _items(laszip))
    if total != header.record_size:
        raise ScanError(f"LASzip unpacks {total} bytes a point, the header declares {header.record_size}")


def _check_chunk_table(header: LasHeader, laszip: bytes, buffer: mmap.mmap, file: BinaryIO) -> None:
    """Hold the table of the chunks that points are packed in against their number, and against the file's size."""
    import lazrs  # noqa: PLC0415 - most scans are not compressed

    cut = f"truncated: header declares {header.n} points, the file ends before them or their table; upload it again"
    if header.start + 16 > len(buffer):
        raise ScanError(cut)
    at = int(struct.unpack_from("<q", buffer, header.start)[0])
    if at == -1:  # written by who could not go back
        at = int(struct.unpack_from("<q", buffer, len(buffer) - 8)[0])
    if not header.start + 8 <= at <= len(buffer) - 8:
        raise ScanError(cut)
    chunk_size = int(struct.unpack_from("<I", laszip, 12)[0])
    version, n_chunks = struct.unpack_from("<II", buffer, at)
    varies = chunk_size in (0, _ANY_SIZE)
    most = min(
        header.n, (at - header.start - 8) // header.record_size
    )  # the first point of each is not packed
    if version != 0 or not (n_chunks <= most if varies else n_chunks == -(-header.n // chunk_size)):
        raise ScanError(
            f"a table (version {version}) of {n_chunks} chunks of {chunk_size} points is declared for {header.n} points"
        )
    try:
        file.seek(header.start)
        chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(laszip))
    except (lazrs.LazrsError, OSError) as error:
        raise ScanError(
            f"the table of its packed points is damaged ({str(error)[:200]}); upload it again"
        ) from None
    if varies and sum(points for points, _ in chunks) != header.n:
        raise ScanError(
            f"its chunks hold {sum(points for points, _ in chunks)} points, the header declares {header.n}"
        )
    packed = sum(size for _, size in chunks)
    if packed != at - header.start - 8:
        raise ScanError(
            f"its chunks take {packed} bytes, but {at - header.start - 8} lie before their table; upload it again"
        )
    if struct.unpack_from("<H", laszip)[0] == _LAYERED:
        _check_layers(header, laszip, buffer, chunks)


def _check_layers(
    header: LasHeader, laszip: bytes, buffer: mmap.mmap, chunks: Sequence[tuple[int, int]]
) -> None:
    """Hold the layers of each chunk against its bytes: lazrs takes memory by what they declare.

    A chunk of formats 6 to 10 is a point as it stands, a count, the bytes of each layer, and the layers.
    """
    n_layers = 0
    for kind, size in _items(laszip):
        if kind not in _LAYERS and kind != _BYTES:
            raise ScanError(f"LASzip item {kind} is not one of layers")
        n_layers += size if kind == _BYTES else _LAYERS[kind]
    at, before = header.start + 8, header.record_size + 4 + 4 * n_layers
    for number, (_, size) in enumerate(chunks, 1):
        if size < before:
            raise ScanError(
                f"chunk {number} of {len(chunks)} has {size} bytes, its sizes alone take {before}"
            )
        layers = np.frombuffer(buffer, "<u4", count=n_layers, offset=at + before - 4 * n_layers)
        if before + int(layers.sum(dtype=np.int64)) > size:
            raise ScanError(f"chunk {number} of {len(chunks)} has {size} bytes, its layers declare more")
        at += size


def _items(laszip: bytes) -> list[tuple[int, int]]:
    """Return kind and bytes of each part of a point, as the record of LASzip has them."""
    n_items = struct.unpack_from("<H", laszip, 32)[0]
    return [struct.unpack_from("<HH", laszip, 34 + 6 * item) for item in range(n_items)]


def _check_gain(header: LasHeader, size: int, *, max_points: int) -> None:
    """Refuse points that would unpack to more than they are worth."""
    plain, packed = header.n * header.record_size, size - header.start
    most = max(_PLAIN_PER_POINT * max_points, _HARMLESS)
    if plain > most:
        raise ScanTooLarge(f"the points unpack to {plain} bytes, the limit is {most}; leave out extra fields")
    least = header.n * _RECORD_SIZES[0]
    if least > max(packed * _HONEST_GAIN, _HARMLESS):
        raise ScanError(
            f"{packed} packed bytes are said to hold {header.n} points, as no scan's do; write them as LAS"
        )


def _plain(header: LasHeader, buffer: mmap.mmap) -> Iterator[NDArray[np.uint8]]:
    """Yield the points (K, record_size) as they lie in the file."""
    rows = np.frombuffer(buffer, np.uint8, count=header.n * header.record_size, offset=header.start)
    yield from _split(rows.reshape(header.n, header.record_size))


def _split(rows: NDArray[np.uint8]) -> Iterator[NDArray[np.uint8]]:
    return (rows[at : at + _POINTS_AT_ONCE] for at in range(0, len(rows), _POINTS_AT_ONCE))


def _unpacked(header: LasHeader, laszip: bytes, file: BinaryIO) -> Iterator[NDArray[np.uint8]]:
    """Yield the points (K, record_size) of a LAZ. Raises ScanError for what lazrs says is damaged."""
    import lazrs  # noqa: PLC0415 - most scans are not compressed

    at_once = max(1, min(_POINTS_AT_ONCE, _AT_ONCE // header.record_size))
    try:
        file.seek(header.start)
        unpacker = lazrs.LasZipDecompressor(file, laszip)
        for start in range(0, header.n, at_once):
            rows = np.empty((min(at_once, header.n - start), header.record_size), np.uint8)
            unpacker.decompress_many(rows.reshape(-1))
            yield rows
    except lazrs.LazrsError as error:
        raise ScanError(f"compressed points are damaged ({str(error)[:200]}); upload it again") from None


def _column(rows: NDArray[np.uint8], at: int, kind: str) -> NDArray[Any]:
    """Return one value (K,) of each point, `at` bytes from its beginning."""
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(rows[:, at : at + size]).view(kind)[:, 0]


def _put_positions(rows: NDArray[np.uint8], header: LasHeader, store: ColumnStore, piece: slice) -> None:
    withheld = (rows[:, 15] & (0x80 if header.point_format < 6 else 0x04)) > 0
    for axis, name in enumerate("xyz"):
        values = _column(rows, 4 * axis, "<i4") * header.scales[axis] + header.offsets[axis]
        values[withheld] = np.nan
        store.positions[name][piece] = values


def _put_colors(rows: NDArray[np.uint8], header: LasHeader, store: ColumnStore, piece: slice) -> int:
    """Keep the colours of some points; return the brightest value."""
    at = _COLORS_AT.get(header.point_format)
    if at is None:
        return 0
    brightest = 0
    for channel in range(3):
        values = _column(rows, at + 2 * channel, "<u2")
        store.wide_colors[channel][piece] = values
        brightest = max(brightest, int(values.max(initial=0)))
    return brightest
