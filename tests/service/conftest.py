"""A service to ask: SQLite and blobs in a temporary folder, a queue that only remembers, one model's card."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from samples import MODEL, RememberingQueue

from service.api.app import create_app
from service.catalog.catalog import Catalog, open_catalog
from service.settings import Settings


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    card = tmp_path / "models" / "spicd-net" / "1" / "card.json"
    card.parent.mkdir(parents=True)
    card.write_text(json.dumps({"name": "spicd-net", "version": "1", "threshold": 0.5}))
    return Settings(
        data_dir=tmp_path / "data", model_store=tmp_path / "models", model=MODEL, max_upload_bytes=200_000
    )


@pytest.fixture
def catalog(settings: Settings) -> Iterator[Catalog]:
    opened = open_catalog(settings)
    yield opened
    opened.close()


@pytest.fixture
def queue() -> RememberingQueue:
    return RememberingQueue()


@pytest.fixture
def client(settings: Settings, queue: RememberingQueue) -> Iterator[TestClient]:
    """Shares the folder of `catalog`, as a worker would."""
    with TestClient(create_app(settings, queue=queue), raise_server_exceptions=False) as opened:
        yield opened
