"""Files of the service: others on the machine read none of them, also not those of an earlier release."""

from __future__ import annotations

import logging
import os
import stat
from pathlib import Path

import pytest

from service.permissions import make_private, private_files


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


@pytest.fixture(autouse=True)
def usual_umask():
    before = os.umask(0o022)
    yield
    os.umask(before)


def test_a_folder_that_everybody_reads_is_taken_from_them(tmp_path: Path) -> None:
    data = tmp_path / "data"
    (data / "blobs" / "scans").mkdir(parents=True)
    (data / "blobs" / "scans" / "a.ply").write_bytes(b"ply")
    (data / "run.sh").write_text("")
    (data / "run.sh").chmod(0o755)
    assert mode(data) == 0o755
    make_private(data)
    assert {mode(path) for path in (data, data / "blobs", data / "blobs" / "scans")} == {0o700}
    assert mode(data / "blobs" / "scans" / "a.ply") == 0o600
    assert mode(data / "run.sh") == 0o700


def test_what_a_link_leads_to_is_left_alone(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    (outside / "folder").mkdir(parents=True)
    (outside / "file").touch()
    data = tmp_path / "data"
    data.mkdir()
    (data / "file").symlink_to(outside / "file")
    (data / "folder").symlink_to(outside / "folder")
    make_private(data)
    assert (mode(outside / "file"), mode(outside / "folder")) == (0o644, 0o755)


def test_a_folder_that_is_shared_on_purpose_is_left_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / "file").touch()
    with caplog.at_level(logging.WARNING):
        make_private(shared)
        assert "SPICD_DATA_DIR" in caplog.text
    assert (mode(shared), mode(shared / "file")) == (0o1777, 0o644)


def test_a_folder_that_is_not_there_is_made(tmp_path: Path) -> None:
    make_private(tmp_path / "a" / "data")
    assert mode(tmp_path / "a" / "data") == 0o700


def test_new_files_are_private_within_the_block_alone(tmp_path: Path) -> None:
    with private_files():
        (tmp_path / "in").touch()
    (tmp_path / "out").touch()
    assert (mode(tmp_path / "in"), mode(tmp_path / "out")) == (0o600, 0o644)
