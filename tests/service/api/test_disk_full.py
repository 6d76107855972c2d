"""A full disk: what is refused, what goes on, and how it is emptied."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.files.disk import BALLAST_BYTES
from service.settings import Settings
from tests.support.samples import (
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    catalog_of,
    ply,
    running,
    settings_in,
    tile,
)
from tests.support.small_disk import SmallDisk, small_disk

MEGABYTES = 96


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    with small_disk(tmp_path / "disk", MEGABYTES) as disk:
        yield disk


@pytest.fixture
def settings(disk: SmallDisk) -> Settings:
    return settings_in(disk.folder).model_copy(update={"min_free_bytes": 8 << 20, "database_url": None})


def upload(client: TestClient, content: str, **headers: str) -> int:
    headers = {"Content-Type": "application/octet-stream", **headers}
    answer = client.post("/scans", content=ply(content), headers=headers)
    if answer.status_code == 507:
        assert answer.json()["type"] == "urn:spicd:problem:disk_full"
    return answer.status_code


def large_map(catalog: Catalog, name: str) -> str:
    """A map with a survey of 4,000 tiles, about a megabyte of rows; the survey's id."""
    add_map(catalog, name)
    survey, _ = add_survey(catalog, [tile(x, y) for x in range(80) for y in range(50)], map_id=name)
    catalog.blobs.put_bytes(f"surveys/{survey}/cloud.ply", bytes(1 << 20))
    return survey


def test_under_the_reserve_nothing_new_is_taken(client: TestClient, disk: SmallDisk) -> None:
    scan = add_scan(catalog_of(client), "kept")
    disk.fill(leave=4 << 20)
    assert upload(client, "new") == 507
    assert client.post("/maps", json={"scan_ids": [scan.scan_id]}).status_code == 507
    assert client.get("/scans").status_code == 200
    disk.clear()
    assert upload(client, "new") == 201
    assert client.post("/maps", json={"scan_ids": [scan.scan_id]}).status_code == 202


def test_a_body_that_would_not_fit_is_refused_by_its_length(client: TestClient, disk: SmallDisk) -> None:
    disk.fill(leave=(8 << 20) + 50_000)
    body = ply("large") + bytes(150_000)
    answer = client.post("/scans", content=body, headers={"Content-Type": "application/octet-stream"})
    assert (answer.status_code, "150" in answer.json()["detail"]) == (507, True)
    assert upload(client, "small") == 201


@pytest.mark.parametrize("size", [100, 5_000, 100_000])
@pytest.mark.parametrize("takes", ["raw", "form"])
def test_a_disk_that_fills_up_while_a_body_comes_is_told_however_small_the_body(
    disk: SmallDisk, settings: Settings, tmp_path: Path, takes: str, size: int
) -> None:
    elsewhere = f"sqlite:///{tmp_path}/rows.sqlite"  # so that the file is what meets the full disk
    blobs = (tmp_path / "blobs").as_uri()
    settings = settings.model_copy(update={"min_free_bytes": 0, "database_url": elsewhere, "blob_url": blobs})
    body = ply("small") + bytes(size)
    with running(settings, RememberingQueue()) as client:
        assert upload(client, "first") == 201  # the folder is there
        disk.fill()
        if takes == "raw":
            answer = client.post("/scans", content=body, headers={"Content-Type": "application/octet-stream"})
        else:
            answer = client.post("/scans", files={"file": ("a.ply", body)})
        assert (answer.status_code, answer.json()["type"]) == (507, "urn:spicd:problem:disk_full")
        assert list((settings.data_dir / "incoming").iterdir()) == []


def test_a_full_disk_can_be_emptied_and_then_takes_scans_again(
    client: TestClient, disk: SmallDisk, settings: Settings
) -> None:
    catalog = catalog_of(client)
    survey = large_map(catalog, "one")
    large_map(catalog, "two")
    spare = add_scan(catalog, "spare")
    ballast = settings.data_dir / "ballast"
    assert ballast.stat().st_size == BALLAST_BYTES
    disk.fill()
    assert disk.free() == 0
    assert client.get("/maps").status_code == 200
    assert client.get(f"/surveys/{survey}/tiles").status_code == 200
    assert upload(client, "new") == 507
    for path in (f"/surveys/{survey}", "/maps/two", "/maps/one", f"/scans/{spare.scan_id}"):
        answer = client.delete(path)
        assert answer.status_code == 204, answer.text
    disk.clear()
    assert upload(client, "new") == 201
    assert client.delete(f"/scans/{client.get('/scans').json()['scans'][0]['scan_id']}").status_code == 204
    assert ballast.stat().st_size == BALLAST_BYTES


def test_the_service_starts_on_a_full_disk_and_deletes(disk: SmallDisk, settings: Settings) -> None:
    with running(settings, RememberingQueue()) as client:
        survey = large_map(catalog_of(client), "one")
    disk.fill()
    with running(settings, RememberingQueue()) as client:
        assert client.get("/maps/one").status_code == 200
        assert upload(client, "new") == 507
        assert client.delete(f"/surveys/{survey}").status_code == 204
        assert client.delete("/maps/one").status_code == 204
