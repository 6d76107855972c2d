"""`spicd up` on a full disk, with its own Redis and database: it starts, and can be emptied."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.settings import Settings
from service.up.embedded_redis import LaunchFailed
from service.up.launcher import up
from tests.support.processes import until
from tests.support.running_service import Service
from tests.support.samples import ply
from tests.support.small_disk import SmallDisk, small_disk

NO_WORKERS = {"geometry_workers": 0, "inference_workers": 0}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    with small_disk(tmp_path / "disk", 128) as disk:
        yield disk


@pytest.fixture
def model_store(tmp_path: Path) -> Path:
    card = tmp_path / "models" / "spicd-net" / "1" / "card.json"
    card.parent.mkdir(parents=True)
    card.write_text(json.dumps({"name": "spicd-net", "version": "1", "threshold": 0.5}))
    return card.parents[2]


def start(folder: Path, disk: SmallDisk, model_store: Path) -> Service:
    """A service whose data folder alone lies on the small disk."""
    folder.mkdir()
    (folder / "data").symlink_to(disk.folder)
    return Service(folder, model_store, model="spicd-net/1", min_free_bytes=8 << 20, **NO_WORKERS)


def test_it_starts_on_a_full_disk_and_what_waits_there_can_be_deleted(
    tmp_path: Path, disk: SmallDisk, model_store: Path
) -> None:
    scan = tmp_path / "hall.ply"
    scan.write_bytes(ply("hall"))
    service = start(tmp_path / "first", disk, model_store)
    try:
        scan_id = service.upload(scan)
        for name in ("one", "two"):
            service.post("/maps", id=name, scan_ids=[scan_id])
    finally:
        service.end()
    disk.fill()
    service = start(tmp_path / "second", disk, model_store)
    try:
        assert service.get("/maps/two")["status"] == "building"
        refused = service.http.post("/maps", json={"scan_ids": [scan_id]})
        assert (refused.status_code, refused.json()["type"]) == (507, "urn:spicd:problem:disk_full")
        for name in ("one", "two"):
            assert service.http.delete(f"/maps/{name}").status_code == 204
        assert service.http.delete(f"/scans/{scan_id}").status_code == 204
        disk.clear()
        until(lambda: service.http.get("/health/ready").status_code == 200)
        service.post("/maps", id="three", scan_ids=[service.upload(scan)])
    finally:
        service.end()


def test_without_a_byte_left_the_start_says_what_to_do(disk: SmallDisk) -> None:
    disk.fill()
    with pytest.raises(LaunchFailed, match="is full: remove what is not the service's"):
        up(Settings(data_dir=disk.folder, port=0, **NO_WORKERS), on_ready=lambda _: None)  # type: ignore[arg-type]
