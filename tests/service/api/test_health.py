"""/models, /health and /metrics."""

from __future__ import annotations

import json
import shutil
import threading

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text

from service.api.http.answering.problems import MEDIA_TYPE
from service.api.http.monitor import HealthMonitor, Part
from service.catalog.catalog import Catalog
from service.errors import QueueUnavailable
from service.queue import QueueState
from service.settings import Settings
from tests.support.processes import until
from tests.support.samples import RememberingQueue, add_map


def test_the_cards_are_passed_on_as_they_are_newest_version_first(
    client: TestClient, settings: Settings
) -> None:
    for version in ("2", "10"):
        folder = settings.model_store / "spicd-net" / version
        folder.mkdir()
        (folder / "card.json").write_text(json.dumps({"name": "spicd-net", "version": version, "any": [1]}))
    found = client.get("/models").json()
    assert [card["version"] for card in found["models"]] == ["10", "2", "1"]
    assert found["default"] == "spicd-net/1"
    assert client.get("/models/spicd-net").json() == {"name": "spicd-net", "version": "10", "any": [1]}
    assert client.get("/models/spicd-net?version=1").json()["threshold"] == 0.5


def test_a_card_that_cannot_be_read_hides_no_other(client: TestClient, settings: Settings) -> None:
    folder = settings.model_store / "broken" / "1"
    folder.mkdir(parents=True)
    (folder / "card.json").write_text("{")
    assert [card["name"] for card in client.get("/models").json()["models"]] == ["spicd-net"]


def test_a_healthy_service_names_its_parts(client: TestClient) -> None:
    assert client.get("/health/live").json() == {"status": "ok"}
    ready = client.get("/health/ready")
    assert (ready.status_code, ready.json()) == (
        200,
        {
            "status": "ok",
            "checks": dict.fromkeys(("workers", "database", "queue", "blobs"), "ok"),
            "reasons": {},
        },
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (QueueState(), "no geometry worker answers; no inference worker answers"),
        (
            QueueState(answering=("host-1",), silent=("host-2",)),
            "1 geometry workers are silent; 1 inference workers are silent",
        ),
    ],
    ids=["none", "one of two"],
)
def test_workers_that_do_not_answer_are_told_and_work_is_taken_all_the_same(
    client: TestClient, queue: RememberingQueue, state: QueueState, reason: str
) -> None:
    queue.state = state
    until(lambda: client.get("/health/ready").json()["status"] == "degraded")
    answer = client.get("/health/ready")
    assert answer.status_code == 200
    assert answer.json()["checks"]["workers"] == "failed"
    assert reason in answer.json()["reasons"]["workers"]
    assert "host" not in answer.text  # who works where is nobody's business without a key


@pytest.mark.slow
def test_a_part_that_fails_is_named_and_the_others_stay_ok(
    client: TestClient, catalog: Catalog, queue: RememberingQueue, settings: Settings
) -> None:
    def seen(part: str, check: str) -> bool:
        """Whether the monitor, which asks every two seconds, has come to this."""
        return bool(client.get("/health/ready").json()["checks"][part] == check)

    queue.down = True
    until(lambda: seen("queue", "failed"))
    answer = client.get("/health/ready")
    assert (answer.status_code, answer.headers["content-type"]) == (503, MEDIA_TYPE)
    assert answer.json()["checks"] == {"workers": "ok", "database": "ok", "queue": "failed", "blobs": "ok"}
    assert answer.json()["reasons"] == {"queue": "the job queue does not answer"}
    queue.down = False
    shutil.rmtree(settings.data_dir / "blobs")
    (settings.data_dir / "blobs").write_text("in the way")
    until(lambda: seen("blobs", "failed"))
    with catalog.database.write() as session:
        session.execute(text("ALTER TABLE jobs RENAME TO gone"))
    until(lambda: seen("database", "failed"))
    until(lambda: seen("queue", "ok"))
    assert client.get("/health/live").status_code == 200


def test_a_part_that_hangs_is_told_of_and_nobody_waits_for_it() -> None:
    gate = threading.Event()
    parts = {
        "hangs": Part(ping=lambda: assert_true(gate.wait(60)), limit_s=0.1),
        "well": Part(ping=lambda: None),
    }
    monitor = HealthMonitor(parts)
    monitor.start()
    until(lambda: (monitor.failures()["hangs"] or "").startswith("no answer for"))
    assert monitor.failures()["well"] is None
    gate.set()
    until(lambda: monitor.failures()["hangs"] is None)
    monitor.stop()


@pytest.mark.parametrize(("starts_s", "logged"), [(60.0, 0), (0.0, 1)])
def test_a_part_that_still_starts_is_no_warning(
    starts_s: float, logged: int, caplog: pytest.LogCaptureFixture
) -> None:
    def absent() -> None:
        raise QueueUnavailable("no geometry worker answers")

    monitor = HealthMonitor({"workers": Part(ping=absent, starts_s=starts_s)})
    monitor.start()
    monitor.stop()
    assert monitor.failures() == {"workers": "no geometry worker answers"}
    assert [record.levelname for record in caplog.records].count("WARNING") == logged


def assert_true(value: bool) -> None:
    assert value


def test_metrics_count_requests_by_route_and_jobs_by_state(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog, ready=False)
    client.get("/maps/lobby")
    client.get("/maps/none")
    client.get("/somewhere")
    text = client.get("/metrics").text
    assert 'spicd_requests_total{method="GET",route="/maps/{map_id}",status="200"} 1.0' in text
    assert 'spicd_requests_total{method="GET",route="/maps/{map_id}",status="404"} 1.0' in text
    assert 'spicd_requests_total{method="GET",route="none",status="404"} 1.0' in text
    assert 'spicd_request_seconds_count{method="GET",route="/maps/{map_id}"} 2.0' in text
    assert 'spicd_jobs{status="accepted"} 1.0' in text
    assert 'spicd_jobs{status="failed"} 0.0' in text
