"""The API while a part of it is away: what waits, what does not, and what a client is told."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from fastapi.testclient import TestClient
from httpx import Response

from service.catalog.files.blobs import Blobs
from service.catalog.sql.patience import Patience
from service.settings import Settings
from tests.support.processes import until
from tests.support.samples import (
    RememberingQueue,
    add_map,
    catalog_of,
    running,
    services_of,
    settings_in,
)
from tests.support.servers import Locked, SilentServer, postgresql

HASTY = Patience(
    connect_s=1, lock_s=1, statement_s=1, write_s=3, blob_s=0.5, blob_request_s=1, blob_retry_s=0.2
)


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch) -> Iterator[SilentServer]:
    server = SilentServer()
    for name, value in server.as_s3().items():
        monkeypatch.setenv(name, value)
    yield server
    server.close()


def test_sixty_writers_that_wait_for_a_lock_hold_up_neither_health_nor_reads(
    client: TestClient, settings: Settings
) -> None:
    add_map(catalog_of(client))
    with ThreadPoolExecutor(60) as robots, Locked(settings.data_dir / "spicd.sqlite"):
        writes = [robots.submit(client.delete, "/maps/lobby/anchor") for _ in range(60)]
        until(lambda: services_of(client).writes.calls == 60)
        answers = [client.get(path) for path in ("/health/live", "/health/ready", "/maps", "/maps/lobby")]
        assert not any(write.done() for write in writes)  # nobody's wait was over before
        assert [answer.status_code for answer in answers] == [200] * 4
        told = writes[0].result()
        assert problem_type(told) in ("database_unavailable", "unavailable")
        assert int(told.headers["Retry-After"]) > 0
    assert {write.result().status_code for write in writes} <= {204, 503}
    assert client.delete("/maps/lobby/anchor").status_code == 204


def test_a_read_of_a_database_that_is_away_is_503_and_comes_back(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    with postgresql() as server:
        settings = settings_in(tmp_path_factory.mktemp("api")).model_copy(
            update={"database_url": server.database()}
        )
        with running(settings, RememberingQueue()) as client:
            for stop, start in ((server.kill, server.start), (server.freeze, server.thaw)):
                assert client.get("/maps").status_code == 200
                stop()
                away(client)
                start()
                until(lambda: client.get("/maps").status_code == 200)
                until(lambda: client.get("/health/ready").status_code == 200)


def problem_type(answer: Response) -> str:
    return str(answer.json()["type"]).rpartition(":")[2]


def away(client: TestClient) -> None:
    answer = client.get("/maps")
    assert (answer.status_code, problem_type(answer)) == (503, "database_unavailable")
    assert int(answer.headers["Retry-After"]) > 0
    until(lambda: client.get("/health/ready").status_code == 503)
    health = client.get("/health/ready").json()
    assert health["checks"] == {"workers": "ok", "database": "failed", "queue": "ok", "blobs": "ok"}
    assert health["reasons"]["database"]
    assert client.get("/health/live").status_code == 200


def test_a_blob_store_that_hangs_is_named_and_holds_no_download_for_long(
    client: TestClient, silent: SilentServer, settings: Settings
) -> None:
    add_map(catalog_of(client))
    hanging = Blobs("s3://bucket/prefix", patience=HASTY)
    catalog = catalog_of(client)
    object.__setattr__(catalog, "blobs", hanging)
    answer = client.get("/maps/lobby/cloud.ply")
    assert (answer.status_code, problem_type(answer)) == (503, "blobs_unavailable")
    assert "no answer in time" in answer.json()["detail"]
    assert int(answer.headers["Retry-After"]) > 0


def test_readiness_names_the_blob_store_that_hangs(
    settings: Settings, queue: RememberingQueue, silent: SilentServer
) -> None:
    with running(settings.model_copy(update={"blob_url": "s3://bucket/prefix"}), queue) as client:
        answer = client.get("/health/ready")
        assert answer.status_code == 503
        assert answer.json()["checks"]["blobs"] == "failed"
        assert "no answer" in answer.json()["reasons"]["blobs"]
        assert client.get("/health/live").status_code == 200
