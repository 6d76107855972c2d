"""The id of a request: taken or made, in the answer and in every line of its log."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.jobs import Jobs
from service.logs import _note_about
from service.settings import Settings
from tests.support.samples import RememberingQueue, add_map, catalog_of, ply, running


class Lines(logging.Handler):
    """Keeps what is logged with what it is about."""

    def __init__(self) -> None:
        super().__init__(logging.DEBUG)
        self.addFilter(_note_about)
        self.records: list[Any] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)

    def of(self, name: str) -> list[Any]:
        return [record for record in self.records if record.name == name]


@pytest.fixture
def lines() -> Iterator[Lines]:
    handler, root = Lines(), logging.getLogger()
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.DEBUG)
    yield handler
    root.removeHandler(handler)
    root.setLevel(level)


def test_an_id_is_taken_and_returned(client: TestClient, lines: Lines) -> None:
    answer = client.get("/maps", headers={"X-Request-ID": "robot-7.42_a"})
    assert answer.headers["x-request-id"] == "robot-7.42_a"
    (line,) = lines.of("spicd.requests")
    assert line.about == {"request_id": "robot-7.42_a"}


@pytest.mark.parametrize("given", ["", "a b", "x" * 65, "a;b", 'a"b'])
def test_what_is_no_id_is_replaced(client: TestClient, given: str) -> None:
    answer = client.get("/maps", headers={"X-Request-ID": given})
    assert len(answer.headers["x-request-id"]) == 32
    assert answer.headers["x-request-id"] != client.get("/maps").headers["x-request-id"]


def test_the_line_has_the_route_and_sizes_and_nothing_that_a_client_sent(
    client: TestClient, catalog: Catalog, lines: Lines
) -> None:
    add_map(catalog)
    headers = {"Authorization": "Bearer s3cret", "Accept-Encoding": "identity"}
    answer = client.get("/maps/lobby/changes?survey=s3cret", headers=headers)
    (line,) = lines.of("spicd.requests")
    assert line.levelno == logging.INFO
    assert {**line.fields, "ms": 1} == {
        "method": "GET",
        "route": "/maps/{map_id}/changes",
        "status": 404,
        "ms": 1,
        "received_bytes": 0,
        "sent_bytes": len(answer.content),
    }
    assert line.getMessage().startswith("GET /maps/{map_id}/changes 404, ")
    ours = [record for record in lines.records if record.name.startswith(("spicd", "service"))]
    assert "s3cret" not in "".join(record.getMessage() + str(vars(record)) for record in ours)


def test_bytes_that_come_in_are_counted(client: TestClient, lines: Lines) -> None:
    body = ply()
    headers = {"Content-Type": "application/octet-stream"}
    assert client.post("/scans?filename=a.ply", content=body, headers=headers).status_code == 201
    (line,) = lines.of("spicd.requests")
    assert line.fields["received_bytes"] == len(body)


def test_probes_are_of_interest_to_a_debugger_alone(client: TestClient, lines: Lines) -> None:
    for path in ("/health/live", "/metrics"):
        client.get(path)
    assert {line.levelno for line in lines.of("spicd.requests")} == {logging.DEBUG}


def test_an_unexpected_error_is_answered_and_logged_under_the_id(
    client: TestClient, lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(Jobs, "page", fail)
    answer = client.get("/jobs", headers={"X-Request-ID": "abc"})
    assert (answer.status_code, answer.headers["x-request-id"]) == (500, "abc")
    (line,) = lines.of("spicd.requests")
    assert line.fields["status"] == 500
    (error,) = lines.of("service.api.http.answering.problems")
    assert error.about == {"request_id": "abc"}


def test_one_line_has_the_ids_of_request_and_job(client: TestClient, catalog: Catalog, lines: Lines) -> None:
    add_map(catalog)
    job_id = client.post(
        "/maps/lobby/surveys", files={"scans": ("a.ply", ply())}, headers={"X-Request-ID": "abc"}
    ).json()["job_id"]
    (line,) = lines.of("service.api.http.reading.submission")
    assert line.about == {"request_id": "abc", "job_id": job_id}


def test_the_line_names_the_key_by_its_id_alone(
    settings: Settings, queue: RememberingQueue, lines: Lines
) -> None:
    with running(settings.model_copy(update={"auth": "required"}), queue) as client:
        record, secret = catalog_of(client).keys.add("robot", scopes=["changes:read"])
        assert client.get("/maps", headers={"Authorization": f"Bearer {secret}"}).status_code == 200
        assert client.get("/maps").status_code == 401
    named, nameless = lines.of("spicd.requests")
    assert named.fields["key_id"] == record.key_id
    assert named.getMessage().endswith(f", key {record.key_id}")
    assert "key_id" not in nameless.fields
