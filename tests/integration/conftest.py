"""A bench of one test's own, and a house."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from service.catalog.catalog import open_catalog
from service.up.embedded_redis import EmbeddedRedis
from tests.support.bench import Bench
from tests.support.house import House, Material, environment, made_material


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with EmbeddedRedis(tmp_path / "redis") as server, Bench(tmp_path, server.url) as bench:
        yield bench


@pytest.fixture(scope="session")
def material(tmp_path_factory: pytest.TempPathFactory) -> Material:
    with one_thread():
        return made_material(tmp_path_factory.mktemp("material"), tmp_path_factory.mktemp("temporary"))


@pytest.fixture
def house(material: Material, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[House]:
    shutil.copytree(material.data, tmp_path / "data")
    settings = environment(monkeypatch, tmp_path / "data", material.model_store)
    catalog = open_catalog(settings, migrate=False)
    with one_thread():
        yield House(catalog=catalog, settings=settings, folder=tmp_path, material=material)
    catalog.close()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """On a busy machine the threads of so small a network wait for each other most of the time."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
