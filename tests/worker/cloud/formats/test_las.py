"""LAS and LAZ: sound files of every point format, and files that were damaged or made to do harm."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.support.clouds import write_las
from worker.cloud.formats.scan import Scan, read_scan
from worker.errors import ScanError, ScanTooLarge, ScanUnits

N = 500
GRID = np.array([412_345.0, 5_654_321.0, 118.0])  # metres, a place in UTM zone 32


def room(seed: int = 0) -> np.ndarray:
    """Points (N, 3) in a room of 6 x 4 x 3 m, in steps of a millimetre."""
    rng = np.random.default_rng(seed)
    return np.round(rng.uniform((-3, -2, 0), (3, 2, 3), (N, 3)), 3)


def read(path: Path, **known: Any) -> Scan:
    """Read a file in this process."""
    return read_scan(path, apart=False, **known)


def changed(path: Path, at: int, kind: str, *values: float) -> Path:
    """The file with other numbers in its header."""
    content = bytearray(path.read_bytes())
    struct.pack_into(f"<{kind}", content, at, *values)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("ending", ["las", "laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_every_point_format_is_read_point_for_point(tmp_path, point_format, ending):
    points = room()
    colored = point_format in (2, 3, 5, 7, 8, 10)
    colors = np.stack([np.arange(N) * 131, np.full(N, 65_535), np.full(N, 256 * 7)], axis=1).astype(np.uint16)
    path = tmp_path / f"room.{ending}"
    write_las(path, points, point_format=point_format, colors=colors if colored else None)
    scan = read(path)
    assert_allclose(scan.points, points, atol=1e-6)
    assert (scan.n_dropped, scan.n_far, scan.tells_sensor) == (0, 0, False)
    assert_array_equal(scan.offset, np.zeros(3))
    if colored:
        assert_array_equal(scan.colors, colors >> 8)
    else:
        assert scan.colors is None


@pytest.mark.parametrize("version", ["1.2", "1.3", "1.4"])
def test_every_version_and_extra_bytes_are_read(tmp_path, version):
    path = write_las(tmp_path / "room.laz", room(), version=version, extra=3)
    assert_allclose(read(path).points, room(), atol=1e-6)


def test_colours_of_eight_bits_are_taken_as_they_stand_and_black_ones_are_none(tmp_path):
    dim = np.stack([np.full(N, 200), np.arange(N) % 256, np.zeros(N)], axis=1).astype(np.uint16)
    assert_array_equal(read(write_las(tmp_path / "a.las", room(), colors=dim)).colors, dim)
    assert read(write_las(tmp_path / "b.las", room(), colors=np.zeros((N, 3), np.uint16))).colors is None


def test_coordinates_of_a_grid_lose_a_round_offset_and_no_millimetre(tmp_path):
    scan = read(write_las(tmp_path / "utm.laz", room() + GRID))
    assert_array_equal(scan.offset, [412_300, 5_654_300, 100])
    assert_allclose(scan.points + scan.offset, room() + GRID, atol=1e-5)  # a float32 there steps by 0.5 m


def test_withheld_points_are_dropped_and_counted(tmp_path):
    withheld = np.arange(N) < 7
    for point_format in (3, 7):
        path = write_las(tmp_path / "room.laz", room(), point_format=point_format, withheld=withheld)
        scan = read(path)
        assert scan.n_dropped == 7
        assert_allclose(scan.points, room()[7:], atol=1e-6)


def test_far_points_are_left_out_and_counted(tmp_path):
    points = np.concatenate([room(), [[5000.0, 0, 0]]])
    scan = read(write_las(tmp_path / "far.las", points))
    assert (len(scan.points), scan.n_far) == (N, 1)


def test_millimetres_are_told(tmp_path):
    with pytest.raises(ScanUnits, match="looks like millimetres"):
        read(write_las(tmp_path / "mm.laz", room() * 1000))


def test_a_real_room_is_the_same_as_laz(shared_data, tmp_path):
    known = read_scan(shared_data / "formats/room808_le_f32_rgb.ply")
    assert known.colors is not None
    path = tmp_path / "room.laz"
    write_las(path, known.points.astype("d"), point_format=7, colors=known.colors.astype(np.uint16) * 257)
    scan = read_scan(path)  # in a process of its own, as a worker does
    assert_allclose(scan.points, known.points, atol=6e-4)
    assert_array_equal(scan.colors, known.colors)


#: where in the header, its type, what is written there, and what is said of it
HEADER = [
    (25, "B", (9,), "version 1.9 is none of"),
    (24, "B", (2,), "version 2"),
    (94, "H", (3,), "the header says to take 3 bytes"),
    (94, "H", (60_000,), "the header says to take 60000 bytes"),
    (96, "I", (2**31,), "points begin at byte 2147483648"),
    (100, "I", (2**32 - 1,), "declares 4294967295 records"),
    (100, "I", (9,), "does not end before the points|bytes, .* are left for it"),
    (105, "H", (5,), "cannot take 5 bytes"),
    (104, "B", (0x3F,), "cannot take|disagree"),
    (107, "I", (2**32 - 1,), "header declares 4294967295 points"),
    (131, "d", (0.0,), "scale factors 0,"),
    (131, "d", (float("nan"),), "scale factors nan,"),
    (139, "d", (-0.001,), "scale factors"),
    (131, "d", (1e300,), "scale factors 1e"),
    (155, "d", (float("inf"),), "offsets inf"),
    (155, "d", (1e300,), "offsets 1e"),
]


@pytest.mark.parametrize("ending", ["las", "laz"])
@pytest.mark.parametrize(("at", "kind", "values", "said"), HEADER)
def test_a_header_that_cannot_be_right_is_refused(tmp_path, at, kind, values, said, ending):
    path = changed(write_las(tmp_path / f"room.{ending}", room()), at, kind, *values)
    with pytest.raises(ScanError, match=said):
        read(path)


def test_more_points_than_the_limit_are_refused_before_any_is_read(tmp_path):
    path = write_las(tmp_path / "room.laz", room())
    with pytest.raises(ScanTooLarge, match=f"declares {N} points, the limit is 499"):
        read(path, max_points=N - 1)


@pytest.mark.parametrize("ending", ["las", "laz"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.05, 0.2, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path, share, ending):
    path = write_las(tmp_path / f"room.{ending}", room())
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ScanError):
        read_scan(path)


def test_what_follows_after_the_points_is_refused_unless_the_header_tells_of_it(tmp_path):
    path = write_las(tmp_path / "room.las", room())
    content = path.read_bytes()
    path.write_bytes(content + bytes(3000))
    assert len(read(path).points) == N  # zeros, as of a page
    path.write_bytes(content + b"more")
    with pytest.raises(ScanError, match="4 bytes follow after the declared points"):
        read(path)
    path = write_las(tmp_path / "told.las", room(), point_format=6)
    end = len(path.read_bytes())
    changed(path, 235, "QI", end, 1)
    path.write_bytes(path.read_bytes() + b"x" * 60)
    assert len(read(path).points) == N


def test_a_few_packed_bytes_that_claim_millions_of_points_are_refused_unread(tmp_path):
    path = changed(write_las(tmp_path / "bomb.laz", room()), 107, "I", 40_000_000)
    with pytest.raises(ScanError, match=r"packed bytes are said to hold 40000000 points, as no scan's do"):
        read(path)


def test_points_too_wide_for_the_limit_are_refused(tmp_path):
    path = write_las(tmp_path / "wide.laz", room(), extra=300)
    with pytest.raises(ScanTooLarge, match="unpack to"):
        read(changed(path, 107, "I", 400_000), max_points=400_000)


def test_a_record_of_laszip_that_is_not_of_these_points_is_refused(tmp_path):
    path = write_las(tmp_path / "room.laz", room())
    content = path.read_bytes()
    at = content.index(b"laszip encoded") - 2 + 54
    for offset, value, said in ((0, 9, "compressor 9"), (32, 900, "900 items"), (36, 7, "unpacks")):
        path.write_bytes(content)
        with pytest.raises(ScanError, match=said):
            read(changed(path, at + offset, "H", value))


@pytest.mark.parametrize("at", [0, 8, 12])
def test_a_broken_chunk_table_is_an_error_and_not_the_end_of_the_worker(tmp_path, at):
    path = write_las(tmp_path / "room.laz", room())
    content = path.read_bytes()
    start = struct.unpack_from("<I", content, 96)[0]
    table = struct.unpack_from("<q", content, start)[0]
    where = start if at == 0 else table + at - 8
    path.write_bytes(content[:where] + b"\xff\xff\xff\x7f" + content[where + 4 :])
    with pytest.raises(ScanError):
        read_scan(path)


@pytest.mark.parametrize("point_format", [6, 7, 10])
def test_a_layer_that_claims_gigabytes_is_refused_before_memory_is_taken(tmp_path, point_format):
    path = write_las(tmp_path / "room.laz", room(), point_format=point_format, extra=2)
    content = path.read_bytes()
    start = struct.unpack_from("<I", content, 96)[0]
    layers = start + 8 + struct.unpack_from("<H", content, 105)[0] + 4  # behind the first point and the count
    with pytest.raises(ScanError, match=r"chunk 1 of 1 has .* bytes, its layers declare more"):
        read(changed(path, layers + 4 * 3, "I", 2**32 - 1))
