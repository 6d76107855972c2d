"""A service to ask: SQLite and blobs in a temporary folder, a queue that only remembers, one model's card."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog, open_catalog
from service.settings import Settings
from tests.support.samples import RememberingQueue, catalog_of, running, settings_in
from tests.support.servers import postgresql


@pytest.fixture(scope="session", autouse=True)
def test_database() -> Iterator[None]:
    """Start a PostgreSQL for the tests where SPICD_TEST_DATABASE_URL says `postgresql` and no more."""
    if os.environ.get("SPICD_TEST_DATABASE_URL") != "postgresql":
        yield
        return
    with postgresql() as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPICD_TEST_DATABASE_URL", server.url("postgres"))
        yield


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return settings_in(tmp_path)


@pytest.fixture
def queue() -> RememberingQueue:
    return RememberingQueue()


@pytest.fixture
def client(settings: Settings, queue: RememberingQueue) -> Iterator[TestClient]:
    with running(settings, queue) as opened:
        yield opened


@pytest.fixture
def catalog(request: pytest.FixtureRequest, settings: Settings) -> Iterator[Catalog]:
    """That of the client, where a test has one."""
    if "client" in request.fixturenames:
        yield catalog_of(request.getfixturevalue("client"))
        return
    opened = open_catalog(settings)
    yield opened
    opened.close()
