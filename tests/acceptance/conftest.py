"""A service of real processes, and a room that was scanned twice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.models import make_untrained
from tests.support.running_service import ROOT, Service
from tests.support.two_visits import Visits, simulated_visits

MODEL = "spicd-net/1"


@pytest.fixture(scope="session")
def model_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's models; where the weights are not there, a network that was never trained."""
    shipped = ROOT / "model_store"
    if (shipped / MODEL / "card.json").exists():
        return shipped
    store = tmp_path_factory.mktemp("models")
    make_untrained(store / MODEL)
    return store


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, model_store: Path) -> Iterator[Service]:
    service = Service(tmp_path_factory.mktemp("service"), model_store)
    yield service
    if service.process.poll() is None:
        service.end()


@pytest.fixture(scope="session")
def visits(tmp_path_factory: pytest.TempPathFactory) -> Visits:
    return simulated_visits(tmp_path_factory.mktemp("scans"))
