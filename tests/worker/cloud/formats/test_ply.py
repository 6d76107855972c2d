"""PLY: what a header may say, and how vertices are found between other elements."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from worker.cloud.formats import ply as module
from worker.cloud.formats.ply import write_ply
from worker.cloud.formats.scan import read_scan
from worker.errors import ScanError, ScanTooLarge

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
XYZ = ("property float x", "property float y", "property float z")
VERTEX = ("element vertex 4", *XYZ)
LITTLE, BIG = "binary_little_endian", "binary_big_endian"


def ply(*lines: str, encoding: str = LITTLE, body: bytes = CORNERS.tobytes(), end: str = "\n") -> bytes:
    return end.join(["ply", f"format {encoding} 1.0", *lines, "end_header", ""]).encode() + body


@pytest.fixture
def read(tmp_path: Path):
    def read_bytes(content: bytes, **options):
        path = tmp_path / "scan.ply"
        path.write_bytes(content)
        return read_scan(path, **options)

    return read_bytes


@pytest.mark.parametrize(("encoding", "order"), [(LITTLE, "<"), (BIG, ">")])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_both_byte_orders_and_line_ends_give_the_same_points(read, encoding, order, end):
    scan = read(ply(*VERTEX, encoding=encoding, body=CORNERS.astype(order + "f4").tobytes(), end=end))
    assert_array_equal(scan.points, CORNERS)
    assert scan.points.dtype == np.float32 and scan.points.dtype.isnative
    assert_array_equal(scan.sensor_pose, np.eye(4))


def test_lists_before_the_points_are_walked_by_their_own_lengths(read):
    face, strip = struct.pack(">fH3iH", 1, 3, 0, 1, 2, 7), struct.pack(">fH5iH", 1, 5, 0, 1, 2, 3, 1, 7)
    head = (
        "element face 3",
        "property float area",
        "property list ushort int vertex_indices",
        "property ushort part",
    )
    lines = (*head, *VERTEX)
    empty = struct.pack(">fHH", 1, 0, 7)
    body = face + strip + empty + CORNERS.astype(">f4").tobytes()
    assert_array_equal(read(ply(*lines, encoding=BIG, body=body)).points, CORNERS)


def test_lists_that_run_over_the_end_of_the_file_are_refused(read):
    lines = ("element face 1", "property list uint double weights", *VERTEX)
    body = struct.pack("<I", 0xFFFFFFFF) + CORNERS.tobytes()
    with pytest.raises(ScanError, match="lists of element 'face' run over the end"):
        read(ply(*lines, body=body))


def test_a_negative_list_length_is_refused(read):
    lines = ("element face 1", "property list char char v", *VERTEX)
    with pytest.raises(ScanError, match="a list of -1 values"):
        read(ply(*lines, body=b"\xff" + CORNERS.tobytes()))


def test_more_lists_before_the_points_than_can_be_walked_are_refused(read, monkeypatch):
    monkeypatch.setattr("worker.cloud.formats.ply._LISTS_LIMIT", 2)
    lines = ("element face 3", "property list uchar int v", *VERTEX)
    with pytest.raises(ScanError, match="'face' has 3 lists before the points, the limit is 2"):
        read(ply(*lines, body=bytes(3) + CORNERS.tobytes()))


def test_elements_around_the_points_are_passed_over_in_ascii(read):
    lines = (
        "element camera 1",
        "property list uchar float p",
        *VERTEX,
        "element face 1",
        "property list uchar int v",
    )
    body = b"2 0.5 0.5\n\n0 0 0\n1 0 0\n0 2 0\n0 0 3\n3 0 1 2\n"
    assert_array_equal(read(ply(*lines, encoding="ascii", body=body)).points, CORNERS)


def test_faces_behind_the_points_must_be_there(read):
    lines = (*VERTEX, "element face 2", "property list uchar int v")
    whole = CORNERS.tobytes() + b"\x00\x00"
    assert_array_equal(read(ply(*lines, body=whole)).points, CORNERS)
    with pytest.raises(ScanError, match=r"truncated: 1 bytes after the points"):
        read(ply(*lines, body=whole[:-1]))


def test_bytes_that_the_header_does_not_explain_are_refused(read):
    with pytest.raises(ScanError, match="12 bytes follow after the declared data"):
        read(ply("element vertex 3", *XYZ))


@pytest.mark.parametrize(("prefix"), ["", "diffuse_"])
def test_uchar_colours_are_kept(read, prefix):
    rows = np.zeros(4, [("p", "<f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = CORNERS, [10, 20, 30]
    lines = [f"property uchar {prefix}{name}" for name in ("red", "green", "blue")]
    assert_array_equal(read(ply(*VERTEX, *lines, body=rows.tobytes())).colors, [[10, 20, 30]] * 4)


def test_float_colours_are_scaled_from_0_to_1_and_others_are_not_guessed(read):
    lines = [f"property float {name}" for name in "rgb"]
    shades = np.hstack([CORNERS, np.full((4, 3), [0, 0.5, 1], np.float32)]).astype("<f4")
    assert_array_equal(read(ply(*VERTEX, *lines, body=shades.tobytes())).colors, [[0, 128, 255]] * 4)
    shades[0, 3] = 17
    assert read(ply(*VERTEX, *lines, body=shades.tobytes())).colors is None


@pytest.mark.parametrize("value", ["256", "-1", "1.5", "nan"])
def test_an_ascii_colour_outside_its_type_is_refused(read, value):
    lines = [f"property uchar {name}" for name in ("red", "green", "blue")]
    body = b"0 0 0 1 2 3\n" * 3 + f"0 0 0 1 {value} 3\n".encode()
    with pytest.raises(ScanError, match="field 'green' holds"):
        read(ply(*VERTEX, *lines, encoding="ascii", body=body))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (("element vertex 5", *XYZ), r"declares 5 points \(60 bytes\), file holds 4 \(48 bytes\)"),
        (("element vertex -1", *XYZ), "'element vertex -1' cannot be understood"),
        (("element vertex 99999999999999999999", *XYZ), "cannot be understood"),
        (("element vertex 4",), "'vertex' has rows and no properties"),
        (("element vertex 4", *XYZ[:2]), "0 fields are named 'z'"),
        ((*VERTEX, "property float x"), "2 fields are named 'x'"),
        ((*VERTEX, "element vertex 4", *XYZ), "'vertex' stands twice"),
        ((*VERTEX, "property list uchar int v"), "'vertex' has a list property"),
        (("element vertex 4", "property half x", *XYZ[1:]), "'half x' has a type that PLY does not know"),
        (
            ("element vertex 4", "property int x", *XYZ[1:]),
            "field 'x' is 1 x int32; write positions as one float",
        ),
        ((*VERTEX, "element face 1", "property list float int v"), "'list float int v' has a type"),
        (("property float x", *VERTEX), "'property float x' cannot be understood"),
        (("element face 4", *XYZ), "no element 'vertex'"),
        (("element camera 1000000000000", *XYZ, *VERTEX), "'camera' declares 1000000000000 rows"),
    ],
)
def test_a_header_that_cannot_be_right_is_refused_with_its_numbers(read, lines, message):
    with pytest.raises(ScanError, match=message) as caught:
        read(ply(*lines))
    assert str(caught.value).startswith("scan.ply: ")


@pytest.mark.parametrize("encoding", ["ascii", LITTLE])
def test_more_points_than_the_limit_are_too_large(read, encoding):
    with pytest.raises(ScanTooLarge, match="declares 1000000000000 points, the limit is 50000000"):
        read(ply("element vertex 1000000000000", *XYZ, encoding=encoding))


def test_an_ascii_count_that_the_file_cannot_hold_is_refused_unread(read):
    with pytest.raises(ScanError, match="declares 40000000 points of 3 numbers, file holds 6 bytes"):
        read(ply("element vertex 40000000", *XYZ, encoding="ascii", body=b"0 0 0\n"))


def test_a_comment_over_64_kib_is_refused(read):
    with pytest.raises(ScanError, match="no end_header in the first 65536 bytes"):
        read(ply("comment " + "a" * 70_000, *VERTEX))


def test_an_unknown_format_line_is_refused(read):
    with pytest.raises(ScanError, match=r"'format binary_middle_endian 1\.0'"):
        read(ply(*VERTEX, encoding="binary_middle_endian"))


def test_write_ply_keeps_points_and_colours_and_leaves_nothing_aside(tmp_path):
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3) * 20
    path = tmp_path / "made.ply"
    write_ply(path, CORNERS, colors=colors, scalars={"change_score": np.linspace(0, 1, 4)})
    scan = read_scan(path)
    assert_array_equal(scan.points, CORNERS)
    assert_array_equal(scan.colors, colors)
    assert [p.name for p in tmp_path.iterdir()] == ["made.ply"]


def test_write_ply_types_scalars_by_their_dtype(tmp_path):
    path = tmp_path / "made.ply"
    scalars: dict[str, np.ndarray] = {
        "score": np.arange(4) / 4,
        "state": np.arange(4, dtype=np.uint8),
        "tile": np.arange(4) - 70_000,
    }
    write_ply(path, CORNERS, scalars=scalars)
    header, body = path.read_bytes().split(b"end_header\n")
    assert header.splitlines()[6:] == [
        b"property float scalar_score",
        b"property uchar scalar_state",
        b"property int scalar_tile",
    ]
    rows = np.frombuffer(body, [("p", "<f4", 3), ("score", "<f4"), ("state", "u1"), ("tile", "<i4")])
    for name, values in scalars.items():
        assert_array_equal(rows[name], values)


@pytest.mark.parametrize(
    "scalars",
    [{"two words": np.zeros(4)}, {"short": np.zeros(3)}, {"big": np.full(4, 2**40)}],
)
def test_write_ply_refuses_scalars_that_would_make_a_broken_file(tmp_path, scalars):
    with pytest.raises(ValueError, match=r"scalar field|columns of"):
        write_ply(tmp_path / "made.ply", CORNERS, scalars=scalars)
    assert list(tmp_path.iterdir()) == []


def test_write_ply_tells_what_its_scalars_mean_in_comments_that_readers_pass_over(tmp_path):
    path = tmp_path / "made.ply"
    write_ply(path, CORNERS, scalars={"state": np.arange(4)}, comments=["scalar_state: 0 good, 1 bad"])
    assert path.read_bytes().splitlines()[2] == b"comment scalar_state: 0 good, 1 bad"
    assert_array_equal(read_scan(path).points, CORNERS)


@pytest.mark.parametrize("comment", ["two\nlines", "end\r", "Stra\u00dfe"])
def test_write_ply_refuses_a_comment_that_would_make_a_broken_header(tmp_path, comment):
    with pytest.raises(ValueError, match="one line of ASCII"):
        write_ply(tmp_path / "made.ply", CORNERS, comments=[comment])
    assert list(tmp_path.iterdir()) == []


def test_write_ply_in_pieces_gives_the_same_file(tmp_path, monkeypatch):
    points = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    colors, scalars = np.arange(300).reshape(100, 3).astype(np.uint8), {"n": np.arange(100)}
    write_ply(tmp_path / "whole.ply", points, colors=colors, scalars=scalars)
    monkeypatch.setattr(module, "_AT_ONCE", 7)
    write_ply(tmp_path / "pieces.ply", points, colors=colors, scalars=scalars)
    assert (tmp_path / "pieces.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
