"""Whether a file of points is whole, before it is sent."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.robots.scan_files import FileNotWhole, require_whole

PLY = "ply\nformat {} 1.0\ncomment of a test\nelement vertex {}\nproperty float x\nproperty double y\nproperty uchar z\n{}end_header\n"
PCD = "# .PCD v0.7\nFIELDS x y n\nSIZE 4 4 1\nTYPE F F U\nCOUNT 1 1 3\nWIDTH {}\nHEIGHT 1\nDATA {}\n"
FACES = "element face 2\nproperty list uchar int vertex_indices\n"
LINE = b"1 2 3\n"


def ply(encoding: str, points: int, body: bytes, more: str = "") -> bytes:
    return PLY.format(encoding, points, more).encode() + body


def pcd(encoding: str, points: int, body: bytes) -> bytes:
    return PCD.format(points, encoding).encode() + body


def test_each_whole_file_passes(tmp_path: Path) -> None:
    whole = [
        ply("binary_little_endian", 7, bytes(7 * 13)),
        ply("binary_big_endian", 7, bytes(7 * 13 + 20), FACES),
        ply("ascii", 3, LINE * 3),
        ply("ascii", 3, LINE * 2 + b"1 2 3"),
        pcd("binary", 7, bytes(7 * 11)),
        pcd("ascii", 2, b"1 2 3 4 5\n" * 2),
        pcd("binary_compressed", 7, b"\x05\0\0\0\x4d\0\0\0" + bytes(5)),
    ]
    for content in whole:
        (tmp_path / "hall").write_bytes(content)
        require_whole(tmp_path / "hall")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            ply("binary_little_endian", 7, bytes(40)),
            r"cut off.*7 points \(91 bytes\), 3 of them .* \(40 bytes\)",
        ),
        (ply("binary_little_endian", 7, bytes(90), FACES), "cut off.* 6 of them"),
        (ply("ascii", 3, LINE * 2), "cut off.* 3 points, 2 of them"),
        (ply("ascii", 3, LINE * 2 + b"1 2"), "cut off.* 3 points, 2 of them"),
        (ply("ascii", 3, b"")[:60], "cut off in its header, after 60 bytes"),
        (ply("ascii", 0, b""), "no points are in the file"),
        (b"ply\nformat ascii 1.0\nend_header\n", "no points .* 'vertex'"),
        (pcd("binary", 7, bytes(76)), "cut off.* 6 of them"),
        (pcd("ascii", 2, b"1 2 3 4 5\n"), "cut off.* 1 of them"),
        (
            pcd("binary_compressed", 7, b"\x05\0\0\0\x4d\0\0\0" + bytes(4)),
            "cut off: 7 points .* 5 bytes, 4 of",
        ),
        (pcd("binary_compressed", 7, b"\x05"), "cut off: 7 points"),
        (pcd("binary", 0, b""), "no points are in the file"),
        (b"", "empty"),
    ],
)
def test_what_is_cut_off_or_empty_is_told_with_the_numbers(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "hall").write_bytes(content)
    with pytest.raises(FileNotWhole, match=told) as error:
        require_whole(tmp_path / "hall")
    assert "copy or record it again" in str(error.value)


@pytest.mark.parametrize(
    "content",
    [
        b"ASTM-E57" + bytes(40),
        b"LASF",
        b"\x89PNG",
        b"ply\nformat odd\nelement vertex many\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty quad x\nend_header\n",
        b"VERSION .7\nDATA binary\n",
        b"ply\n" + b"comment\n" * 9000,
    ],
)
def test_other_formats_and_odd_headers_are_left_to_the_service(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "hall").write_bytes(content)
    require_whole(tmp_path / "hall")
