"""Housekeeping: the API sweeps by itself, and leaves alone what looks like another service's files."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.api import housekeeping
from service.catalog.catalog import Catalog
from service.errors import NotFound
from service.settings import Settings
from tests.service.catalog.files.test_retention import aged
from tests.support.samples import RememberingQueue, add_map, add_scan, catalog_of, running, services_of


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(housekeeping, "FIRST_S", 0.05)
    monkeypatch.setattr(housekeeping, "INTERVAL_S", 0.05)


@pytest.fixture
def keeping(often: None, settings: Settings, queue: RememberingQueue) -> Iterator[TestClient]:
    with running(settings.model_copy(update={"keep_scans_days": 30}), queue) as client:
        yield client


def test_the_api_sweeps_by_itself(keeping: TestClient) -> None:
    catalog = catalog_of(keeping)
    scan = add_scan(catalog, "idle")
    aged(catalog)
    until = time.monotonic() + 10
    with pytest.raises(NotFound):
        while time.monotonic() < until:
            catalog.scans.get(scan.scan_id)
            time.sleep(0.02)


def test_a_sweep_that_fails_is_not_the_last(keeping: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def fail(_: object) -> None:
        calls.append(1)
        raise OSError

    monkeypatch.setattr(housekeeping, "sweep", fail)
    until = time.monotonic() + 10
    while len(calls) < 2 and time.monotonic() < until:
        time.sleep(0.02)
    assert len(calls) >= 2


def test_nothing_is_swept_where_more_files_have_no_row_than_kills_leave(
    client: TestClient, catalog: Catalog, caplog: pytest.LogCaptureFixture
) -> None:
    add_map(catalog)
    scan = add_scan(catalog, "idle")
    aged(catalog)
    folders = [Path(catalog.blobs._root or "") / f"scans/scan-{number}-x" for number in range(4)]
    for folder in folders:
        folder.mkdir()
        os.utime(folder, (0, 0))
    services = services_of(client)
    services = replace(services, settings=services.settings.model_copy(update={"keep_scans_days": 30}))
    with caplog.at_level(logging.WARNING):
        housekeeping.sweep(services)
    assert all(folder.is_dir() for folder in folders)
    assert catalog.scans.get(scan.scan_id)
    assert "4 folders of files have no row" in caplog.text
