"""PCD: what a header may say, and how each encoding becomes points."""

from __future__ import annotations

import mmap
import struct
import time
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from worker.cloud.formats.pcd import read_pcd, write_pcd
from worker.cloud.formats.scan import read_scan
from worker.errors import ScanError, ScanTooLarge

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)


def pcd(
    fields: str = "x y z",
    size: str = "4 4 4",
    kind: str = "F F F",
    *,
    count: str | None = None,
    n: object = 4,
    width: object = None,
    viewpoint: str = "0 0 0 1 0 0 0",
    version: str = "0.7",
    data: str = "binary",
    body: bytes = CORNERS.tobytes(),
) -> bytes:
    """A PCD file of four points, with the lines to test put in the header."""
    lines = [f"VERSION {version}", f"FIELDS {fields}", f"SIZE {size}", f"TYPE {kind}"]
    lines += [] if count is None else [f"COUNT {count}"]
    lines += [f"WIDTH {n if width is None else width}", "HEIGHT 1", f"VIEWPOINT {viewpoint}", f"POINTS {n}"]
    return "\n".join(["# .PCD", *lines, f"DATA {data}", ""]).encode() + body


def compressed(plain: bytes, *, declared: int | None = None) -> bytes:
    packed = imagecodecs.lzf_encode(plain)
    return struct.pack("<II", len(packed), len(plain) if declared is None else declared) + packed


@pytest.fixture
def read(tmp_path: Path):
    def read_bytes(content: bytes, **options):
        path = tmp_path / "scan.pcd"
        path.write_bytes(content)
        return read_scan(path, **options)

    return read_bytes


def test_binary_points_come_back_as_written(read):
    assert_array_equal(read(pcd()).points, CORNERS)


def test_positions_are_found_behind_padding_and_repeated_fields(read):
    row = np.dtype([("pad", "u1", 3), ("h", "<f4", 2), ("y", "<f8"), ("x", "<f4"), ("z", "<f8")])
    rows = np.zeros(4, row)
    rows["pad"], rows["h"] = 255, 9
    rows["x"], rows["y"], rows["z"] = CORNERS.T
    header = {"fields": "_ h y x z", "size": "1 4 8 4 8", "kind": "U F F F F", "count": "3 2 1 1 1"}
    assert_array_equal(read(pcd(**header, body=rows.tobytes())).points, CORNERS)


def test_compressed_fields_stand_one_after_another(read):
    blocks = np.arange(8, dtype="<u2").tobytes() + CORNERS.T.tobytes()
    header = {"fields": "ring x y z", "size": "2 4 4 4", "kind": "U F F F", "count": "2 1 1 1"}
    scan = read(pcd(**header, data="binary_compressed", body=compressed(blocks)))
    assert_array_equal(scan.points, CORNERS)


def test_zero_padding_to_a_page_is_allowed_and_other_leftovers_are_not(read):
    assert_array_equal(read(pcd(body=CORNERS.tobytes() + bytes(3911))).points, CORNERS)
    with pytest.raises(ScanError, match=r"^scan.pcd: 12 bytes follow after the declared points"):
        read(pcd(n=3))


def test_ascii_reads_words_for_missing_returns_and_crlf(read):
    text = b"0 0 0\r\nnan 1 1\r\n1 -inf 1\r\n 1e0\t2 3 \r\n"
    scan = read(pcd(data="ascii", body=text).replace(b"0.7\n", b"0.7\r\n"))
    assert_array_equal(scan.points, [[0, 0, 0], [1, 2, 3]])
    assert scan.n_dropped == 2


def test_ascii_with_a_word_or_a_missing_number_names_the_point(read):
    with pytest.raises(ScanError, match=r"point 2 of 4 has 'one' where a number"):
        read(pcd(data="ascii", body=b"0 0 0\n1 one 1\n2 2 2\n3 3 3\n"))
    with pytest.raises(ScanError, match=r"point 3 of 4 has 2 numbers instead of 3"):
        read(pcd(data="ascii", body=b"0 0 0\n1 1 1\n2 2.000000\n3 3 3\n"))
    with pytest.raises(ScanError, match=r"declares 4 points, file holds 3"):
        read(pcd(data="ascii", body=b"0.00 0 0\n1.00 1 1\n2.00 2 2\n"))
    with pytest.raises(ScanError, match="more lines follow"):
        read(pcd(data="ascii", body=b"0 0 0\n" * 5))


def test_ascii_decoded_in_several_bites_is_the_same_and_counts_points_on(read, monkeypatch):
    text = b"0 0 0\n1 0 0\n0 2 0\n0 0 3\n"
    monkeypatch.setattr("worker.cloud.formats.fields._NUMBERS_AT_ONCE", 9)  # three points of three numbers
    assert_array_equal(read(pcd(data="ascii", body=text)).points, CORNERS)
    with pytest.raises(ScanError, match="point 4 of 4 has 'zero'"):
        read(pcd(data="ascii", body=text.replace(b"0 0 3", b"0 zero 3")))


def test_a_line_of_over_a_megabyte_is_refused(read):
    with pytest.raises(ScanError, match="a line of over 1048576 bytes"):
        read(pcd(data="ascii", body=b"0 0 0 " * 200_000))


@pytest.mark.parametrize("kind", ["U", "I", "F"])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
def test_packed_colours_are_the_same_bits_under_any_type(read, kind, name):
    rows = np.zeros(4, [("p", "<f4", 3), ("rgb", "<u4")])
    rows["p"], rows["rgb"] = CORNERS, 0xFF0A141E  # as float this is a huge negative number
    header = {"fields": f"x y z {name}", "size": "4 4 4 4", "kind": f"F F F {kind}"}
    assert_array_equal(read(pcd(**header, body=rows.tobytes())).colors, [[10, 20, 30]] * 4)


def test_separate_colour_fields_follow_their_points_when_one_is_dropped(read):
    rows = np.zeros(4, [("p", "<f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = CORNERS, np.arange(12).reshape(4, 3)
    rows["p"][1, 2] = np.nan
    scan = read(pcd("x y z r g b", "4 4 4 1 1 1", "F F F U U U", body=rows.tobytes()))
    assert_array_equal(scan.colors, [[0, 1, 2], [6, 7, 8], [9, 10, 11]])
    assert scan.n_dropped == 1


def test_viewpoint_is_the_sensor_in_the_scan_frame(read):
    half = np.sqrt(0.5)
    scan = read(pcd(viewpoint=f"1 2 3 {half} 0 0 {half}"))  # a quarter turn to the left
    ahead = scan.sensor_pose @ [1, 0, 0, 1]
    np.testing.assert_allclose(ahead, [1, 3, 3, 1], atol=1e-12)


@pytest.mark.parametrize("viewpoint", ["0 0 0 0 0 0 0", "0 0 0 1 0 0", "0 0 nan 1 0 0 0", "a b c 1 0 0 0"])
def test_a_viewpoint_that_is_no_pose_is_refused(read, viewpoint):
    with pytest.raises(ScanError, match="VIEWPOINT"):
        read(pcd(viewpoint=viewpoint))


@pytest.mark.parametrize("version", [".5", ".6", ".7", "0.5", "0.6", "0.7"])
def test_versions_5_to_7_are_read_and_others_are_not(read, version):
    assert len(read(pcd(version=version)).points) == 4
    with pytest.raises(ScanError, match=r"version '0\.8'"):
        read(pcd(version="0.8"))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"n": 10**15, "width": 10**15}, "limit is 50000000"),
        ({"n": "99999999999999999999"}, "is not a whole number"),
        ({"n": "-4"}, "is not a whole number"),
        ({"n": 4, "width": 5}, "POINTS 4, but WIDTH x HEIGHT is 5 x 1"),
        ({"n": 5}, r"declares 5 points \(60 bytes\), file holds 4 \(48 bytes\)"),
        ({"count": "1 1 1000000000"}, "a point takes 4000000008 bytes"),
        ({"count": "1 1 2"}, "field 'z' is 2 x float32"),
        ({"count": "1 1"}, "2 COUNT"),
        ({"kind": "F F I"}, "field 'z' is 1 x int32; write positions as one float or double in metres"),
        ({"kind": "F F Q"}, "TYPE Q SIZE 4"),
        ({"size": "4 4 3"}, "TYPE F SIZE 3"),
        ({"fields": "x y w"}, "0 fields are named 'z'"),
        ({"fields": "x x z"}, "2 fields are named 'x'"),
        ({"data": "base64"}, "DATA 'base64'"),
    ],
)
def test_a_header_that_cannot_be_right_is_refused_with_its_numbers(read, header, message):
    with pytest.raises(ScanError, match=message) as caught:
        read(pcd(**header))
    assert str(caught.value).startswith("scan.pcd: ")


@pytest.mark.parametrize("line", ["POINTS 4", "NORMALS 1"])
def test_a_header_line_that_is_unknown_or_stands_twice_is_refused(read, line):
    with pytest.raises(ScanError, match=f"'{line.split()[0]}' is unknown or stands twice"):
        read(pcd().replace(b"DATA", f"{line}\nDATA".encode()))


def test_more_points_than_the_limit_are_too_large(read):
    with pytest.raises(ScanTooLarge, match="declares 4 points, the limit is 3"):
        read(pcd(), max_points=3)


def test_a_header_over_64_kib_is_refused(read):
    with pytest.raises(ScanError, match="no DATA line in the first 65536 bytes"):
        read(b"# .PCD" + b" " * 70_000 + b"\n" + pcd())


def test_a_damaged_lzf_block_is_refused(read):
    plain = CORNERS.T.tobytes()
    whole = compressed(plain)
    cases = {
        "hold 48, but 5 points take 60 bytes": pcd(n=5, data="binary_compressed", body=whole),
        "hold 49, but 4 points take 48": pcd(data="binary_compressed", body=compressed(plain, declared=49)),
        "truncated: .* file holds": pcd(data="binary_compressed", body=whole[:-1]),
        "ends before the compressed": pcd(data="binary_compressed", body=whole[:7]),
        "it gives 24 bytes instead of 48": pcd(
            data="binary_compressed", body=compressed(plain[:24], declared=48)
        ),
        "compressed data is damaged": pcd(
            data="binary_compressed", body=whole[:8] + b"\xff" * (len(whole) - 8)
        ),
    }
    for message, content in cases.items():
        with pytest.raises(ScanError, match=message):
            read(content)


def test_a_tiny_block_that_claims_gigabytes_is_refused_before_it_is_unpacked(read):
    body = struct.pack("<II", 3, 300_000_000 * 12) + b"abc"
    bomb = pcd(n=300_000_000, data="binary_compressed", body=body)
    with pytest.raises(ScanError, match="3 compressed bytes are said to hold 3600000000"):
        read(bomb, max_points=400_000_000)


def test_write_pcd_keeps_points_colours_and_sensor_pose(tmp_path):
    pose = np.array([[0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 0.25], [0, 0, 0, 1]])
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3) * 20
    path = tmp_path / "made.pcd"
    write_pcd(path, CORNERS, colors=colors, sensor_pose=pose)
    scan = read_scan(path)
    assert_array_equal(scan.points, CORNERS)
    assert_array_equal(scan.colors, colors)
    np.testing.assert_allclose(scan.sensor_pose, pose, atol=1e-8)
    assert [p.name for p in tmp_path.iterdir()] == ["made.pcd"]


def test_a_block_of_over_64_mib_with_the_gain_of_a_bomb_is_refused(read):
    zeros = b"\x00\x00" + b"\xe0\xff\x00" * 363_636  # 264 zeros out of every three bytes
    body = struct.pack("<II", len(zeros), 8_000_000 * 12) + zeros
    with pytest.raises(ScanError, match="1090910 compressed bytes unpack to 96000000, as no scan's do"):
        read(pcd(n=8_000_000, data="binary_compressed", body=body))


def test_a_block_that_unpacks_to_more_than_the_most_points_take_is_refused(read):
    body = struct.pack("<II", 70_000_000, 2_148_000_000) + bytes(70_000_000)
    wide = {"fields": "x y z pad", "size": "4 4 4 8", "kind": "F F F F", "count": "1 1 1 267"}
    with pytest.raises(ScanTooLarge, match="unpack to 2148000000 bytes, the limit is 1200000000"):
        read(pcd(n=1_000_000, data="binary_compressed", body=body, **wide))


def test_only_the_used_fields_of_a_block_are_kept(tmp_path):
    n, pad = 1000, 500
    plain = np.concatenate([CORNERS.repeat(250, axis=0).T.ravel(), np.zeros(n * pad, np.float32)])
    header = {"fields": "x y z pad", "size": "4 4 4 4", "kind": "F F F F", "count": f"1 1 1 {pad}"}
    path = tmp_path / "scan.pcd"
    path.write_bytes(pcd(n=n, data="binary_compressed", body=compressed(plain.tobytes()), **header))
    with path.open("rb") as file:
        raw = read_pcd(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), max_points=n)
    assert sum(column.nbytes for column in raw.columns.values()) == n * 12
    assert all(column.base is None for column in raw.columns.values())


def test_thousands_of_fields_are_looked_through_at_once(read):
    names, others = " ".join(f"{number:x}" for number in range(6_000)), 6_003
    header = {"fields": f"x y z {names}", "size": " ".join(["4"] * others), "kind": " ".join("F" * others)}
    begun = time.monotonic()
    assert_array_equal(read(pcd(n=1, body=bytes(4 * others), **header)).points, [[0, 0, 0]])
    assert time.monotonic() - begun < 1
