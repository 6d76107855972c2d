"""A file is seen whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from worker.files import write_atomically, write_bytes, write_text


def test_a_failed_write_leaves_the_earlier_file_and_nothing_beside_it(tmp_path: Path) -> None:
    path = write_text(tmp_path / "card.json", "before")

    def half(aside: Path) -> None:
        aside.write_text("ha")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, half)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_reader_sees_the_earlier_file_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = write_bytes(tmp_path / "cloud.ply", b"before")
    seen: list[bytes] = []

    def write(aside: Path) -> None:
        aside.write_bytes(b"after")
        seen.append(path.read_bytes())

    assert write_atomically(path, write) == path
    assert (seen, path.read_bytes()) == ([b"before"], b"after")


def test_parts_come_one_after_the_other_and_text_is_utf_8(tmp_path: Path) -> None:
    assert write_bytes(tmp_path / "parts", b"head", b"body").read_bytes() == b"headbody"
    assert write_text(tmp_path / "text", "5 °").read_bytes() == "5 °".encode()
