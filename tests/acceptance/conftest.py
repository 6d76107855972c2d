"""A service of real processes, and a room that was scanned twice.

The same tests run on the parts that come with the service, and on PostgreSQL and S3: on one host, and on two that share
nothing else but Redis. Where those servers are not installed, these are skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.models import make_untrained
from tests.support.running_service import ROOT, OneOfMany, Service, TwoHosts
from tests.support.servers import shared_parts
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


@pytest.fixture(scope="module", params=["embedded", "one-host", "two-hosts"])
def service(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, model_store: Path
) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("service")
    with ExitStack() as stack:
        if request.param == "embedded":
            service = Service(folder, model_store)
        else:
            shared = stack.enter_context(shared_parts(tmp_path_factory.mktemp("shared")))
            kind = OneOfMany if request.param == "one-host" else TwoHosts
            service = kind(folder, model_store, **shared)
        yield service
        if service.process.poll() is None:
            service.end()


@pytest.fixture(scope="session")
def visits(tmp_path_factory: pytest.TempPathFactory) -> Visits:
    return simulated_visits(tmp_path_factory.mktemp("scans"))
