"""Blobs: whole or absent, by key."""

from __future__ import annotations

import errno
import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.sql.patience import Patience
from service.errors import BlobsUnavailable, DiskFull
from tests.support.servers import SilentServer, free_port, s3_environment


@pytest.fixture
def blobs(tmp_path: Path) -> Blobs:
    return Blobs((tmp_path / "blobs").as_uri())


@pytest.fixture(params=["folder", "elsewhere"])
def either(request: pytest.FixtureRequest, tmp_path: Path) -> Blobs:
    """A local folder, and a store that is not one (obstore's memory stands in for S3)."""
    return Blobs((tmp_path / "blobs").as_uri() if request.param == "folder" else "memory:///")


def test_bytes_come_back_by_key(either: Blobs) -> None:
    either.put_bytes("maps/lobby/cloud.ply", b"ply")
    assert either.get_bytes("maps/lobby/cloud.ply") == b"ply"
    assert either.size("maps/lobby/cloud.ply") == 3
    assert b"".join(either.stream("maps/lobby/cloud.ply")) == b"ply"
    with either.local("maps/lobby/cloud.ply") as path:
        assert path.read_bytes() == b"ply"


def test_a_part_of_a_blob_is_read_and_no_more_than_there_is(either: Blobs) -> None:
    either.put_bytes("maps/lobby/tileset.bin", bytes(range(100)))
    assert either.get_range("maps/lobby/tileset.bin", 10, 5) == bytes(range(10, 15))
    assert either.get_range("maps/lobby/tileset.bin", 95, 50) == bytes(range(95, 100))
    assert either.get_range("maps/lobby/tileset.bin", 100, 1) == b""
    assert either.get_range("maps/lobby/tileset.bin", 10**15, 1) == b""
    with pytest.raises(FileNotFoundError):
        either.get_range("maps/none/tileset.bin", 0, 1)


def test_what_was_put_last_stands(either: Blobs) -> None:
    either.put_bytes("a/b", b"first, longer")
    either.put_bytes("a/b", b"second")
    assert either.get_bytes("a/b") == b"second"


def test_a_file_of_seven_megabytes_comes_back_in_pieces(either: Blobs, tmp_path: Path) -> None:
    source = tmp_path / "scan.bin"
    source.write_bytes(bytes(range(256)) * 28_000)
    either.put_file("scans/s/scan.bin", source)
    pieces = list(either.stream("scans/s/scan.bin"))
    assert b"".join(pieces) == source.read_bytes()


@pytest.mark.parametrize("ask", ["get_bytes", "size", "path", "stream", "local"])
def test_a_missing_key_is_a_missing_file(blobs: Blobs, ask: Any) -> None:
    with pytest.raises(FileNotFoundError):
        if ask == "local":
            with blobs.local("maps/none/cloud.ply"):
                pass
        else:
            getattr(blobs, ask)("maps/none/cloud.ply")
    assert not blobs.exists("maps/none/cloud.ply")


def test_a_moved_file_is_gone_where_it_was(either: Blobs, tmp_path: Path) -> None:
    source = tmp_path / "scan.bin"
    source.write_bytes(b"scan")
    either.put_file("scans/s/scan.bin", source, move=True)
    assert either.get_bytes("scans/s/scan.bin") == b"scan"
    assert not source.exists()


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """What was brought to the disk so far, as paths under `tmp_path`, with the names of the time."""
    paths: list[str] = []

    def fsync(descriptor: int) -> None:
        paths.append(os.path.relpath(Path(f"/proc/self/fd/{descriptor}").readlink(), tmp_path))

    monkeypatch.setattr(os, "fsync", fsync)
    return paths


FOLDERS = ["blobs/scans/s", "blobs/scans", "blobs"]


def test_a_file_is_on_the_disk_before_it_has_its_name_and_then_the_name_is(
    blobs: Blobs, tmp_path: Path, synced: list[str]
) -> None:
    (tmp_path / "hall.part").write_bytes(b"scan")
    blobs.put_file("scans/s/hall.ply", tmp_path / "hall.part", move=True)
    assert synced == ["hall.part", *FOLDERS]


def test_whatever_is_put_is_on_the_disk(blobs: Blobs, tmp_path: Path, synced: list[str]) -> None:
    blobs.put_bytes("scans/s/bytes", b"scan")
    assert synced == ["blobs/scans/s/bytes", *FOLDERS]
    synced.clear()
    (tmp_path / "kept").write_bytes(b"scan")
    blobs.put_file("scans/s/file", tmp_path / "kept")
    assert synced == ["blobs/scans/s/file", *FOLDERS]
    synced.clear()
    blobs.copy("scans/s/file", "scans/s/copy")
    assert synced == FOLDERS


def test_a_disk_that_fails_to_sync_is_told_and_one_that_knows_none_is_taken_as_it_is(
    blobs: Blobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(number: int) -> None:
        def fsync(_: int) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    failing(errno.EINVAL)
    blobs.put_bytes("a/b", b"x")
    failing(errno.ENOSPC)
    with pytest.raises(DiskFull):
        blobs.put_bytes("a/b", b"x")
    failing(errno.EIO)
    with pytest.raises(BlobsUnavailable, match="Input/output error"):
        blobs.put_bytes("a/b", b"x")


def test_a_local_blob_is_read_where_it_lies(blobs: Blobs, tmp_path: Path) -> None:
    blobs.put_bytes("a/b.bin", b"x")
    with blobs.local("a/b.bin") as path:
        assert path == tmp_path / "blobs" / "a" / "b.bin"


def test_a_copy_from_elsewhere_goes_when_it_was_read() -> None:
    elsewhere = Blobs("memory:///")
    elsewhere.put_bytes("a/b.bin", b"x")
    with elsewhere.local("a/b.bin") as path:
        assert path.name == "b.bin"
    assert not path.exists()


def test_many_looks_at_once_find_the_store_well_and_leave_nothing(blobs: Blobs, tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as threads:
        looks = [threads.submit(blobs.ping) for _ in range(200)]
    assert [look.exception() for look in looks if look.exception()] == []
    assert list((tmp_path / "blobs" / "health").iterdir()) == []


def test_a_prefix_takes_its_blobs_and_no_others(either: Blobs) -> None:
    either.put_bytes("maps/lobby/cloud.ply", b"x")
    either.put_bytes("maps/lobby/scans/a.npz", b"x")
    either.put_bytes("maps/lobby2/cloud.ply", b"x")
    either.delete_prefix(blob_keys.map_folder("lobby"))
    either.delete_prefix(blob_keys.map_folder("lobby"))
    assert not either.exists("maps/lobby/cloud.ply")
    assert not either.exists("maps/lobby/scans/a.npz")
    assert either.exists("maps/lobby2/cloud.ply")


def test_a_copy_stays_as_it_was_when_the_first_is_replaced_or_deleted(either: Blobs) -> None:
    either.put_bytes("maps/one/scans/a.npz", b"first")
    for _ in range(2):
        either.copy("maps/one/scans/a.npz", "maps/two/scans/a.npz")
    either.put_bytes("maps/one/scans/a.npz", b"second")
    assert either.get_bytes("maps/two/scans/a.npz") == b"first"
    either.delete_prefix("maps/one/")
    assert either.get_bytes("maps/two/scans/a.npz") == b"first"
    assert either.under("maps/") == ["maps/two/scans/a.npz"]
    with pytest.raises(FileNotFoundError):
        either.copy("maps/one/scans/a.npz", "maps/two/scans/b.npz")


def test_where_the_disk_knows_no_links_a_copy_is_written(
    blobs: Blobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, target: Path) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    blobs.put_bytes("a/b", b"x")
    blobs.copy("a/b", "c/d")
    assert blobs.get_bytes("c/d") == b"x"


def test_the_keys_under_a_folder_are_its_own_and_no_others(either: Blobs) -> None:
    for key in ("maps/one/work/pairs-b.json", "maps/one/work/pairs-a.json", "maps/one2/work/pairs-c.json"):
        either.put_bytes(key, b"[]")
    assert either.under(blob_keys.map_work("one")) == [
        "maps/one/work/pairs-a.json",
        "maps/one/work/pairs-b.json",
    ]
    assert either.under(blob_keys.map_work("none")) == []


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("hall.pcd", "hall.pcd"),
        ("../../etc/passwd", "passwd"),
        ("C:\\scans\\hall 1.ply", "hall_1.ply"),
        ("...", "scan"),
        ("", "scan"),
        ("x" * 300 + ".ply", "x" * 96 + ".ply"),
        ("späť.ply", "sp_.ply"),
    ],
)
def test_a_file_name_becomes_one_harmless_part_of_a_key(given: Any, kept: str) -> None:
    assert blob_keys.safe_name(given) == kept


def test_a_description_belongs_to_one_model() -> None:
    key = blob_keys.map_embedding("lobby", "spicd-net/1", "0123456789abcdef")
    assert key == "maps/lobby/description-spicd-net-1-0123456789ab.npz"
    assert key != blob_keys.map_embedding("lobby", "spicd-net/2", "0123456789abcdef")
    assert key != blob_keys.map_embedding("lobby", "spicd-net/1", "fedcba9876543210")


HASTY = Patience(
    connect_s=1, lock_s=1, statement_s=1, write_s=3, blob_s=0.5, blob_request_s=1, blob_retry_s=0.2
)
HALF_AN_ANSWER = (
    b'HTTP/1.1 200 OK\r\nContent-Length: 100000\r\nETag: "a"\r\nLast-Modified: \
Sun, 01 Mar 2026 12:00:00 GMT\r\n\r\n'
    + bytes(1000)
)


@pytest.fixture
def hanging(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Blobs]:
    """A store in S3 that takes connections and never answers, or stalls within the answer."""
    server = SilentServer(getattr(request, "param", b""))
    for name, value in server.as_s3().items():
        monkeypatch.setenv(name, value)
    yield Blobs("s3://bucket/prefix", patience=HASTY)
    server.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "ask",
    [
        lambda blobs: blobs.ping(),
        lambda blobs: blobs.get_bytes("a/b"),
        lambda blobs: blobs.size("a/b"),
        lambda blobs: blobs.put_bytes("a/b", b"x"),
        lambda blobs: list(blobs.stream("a/b")),
        lambda blobs: blobs.under("a/"),
        lambda blobs: blobs.delete_prefix("a/"),
    ],
)
def test_a_store_that_never_answers_is_given_up(hanging: Blobs, ask: Any) -> None:
    started = time.monotonic()
    with pytest.raises(BlobsUnavailable, match="no answer in time"):
        ask(hanging)
    assert time.monotonic() - started < 10


@pytest.mark.slow
@pytest.mark.parametrize("hanging", [HALF_AN_ANSWER], indirect=True)
def test_a_stream_that_stalls_is_given_up_and_its_copy_goes(
    hanging: Blobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(BlobsUnavailable), hanging.local("a/b"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in s3_environment(free_port()).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(BlobsUnavailable, match="connection refused"):
        Blobs("s3://bucket/prefix", patience=HASTY).ping()
