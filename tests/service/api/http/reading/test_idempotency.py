"""`Idempotency-Key`: a request that is sent again makes nothing a second time, and is given its first answer."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import update

from service.api.http.guards.access import SCOPES
from service.api.http.reading.idempotency import REPLAYED, read_key
from service.catalog import idempotency
from service.catalog.catalog import Catalog
from service.catalog.files import retention
from service.catalog.records import Problem
from service.catalog.sql.tables import IdempotencyKey, now
from service.errors import KeyMalformed
from service.settings import Settings
from tests.support.samples import RememberingQueue, add_map, add_scan, add_survey, ply

KEY = {"Idempotency-Key": '"8e03978e-40d5-43dd-bc93-6894a57f9324"'}
RAW = {"Content-Type": "application/octet-stream"}

MAKE_NOTHING = frozenset(  #: routes whose POST may be sent twice without any harm
    {
        "/uploads",  # one that nobody goes on with expires; what becomes of it is one scan by its bytes
        "/uploads/{upload_id}",  # PATCH, HEAD and DELETE for those who have POST alone
        "/webhooks/{webhook_id}/ping",
        "/webhooks/{webhook_id}/deliveries/{delivery_id}/repeat",  # the receiver knows it by its id
    }
)

Send = Callable[[], httpx.Response]


@pytest.fixture
def lobby(catalog: Catalog) -> str:
    """A map that is ready."""
    add_map(catalog)
    return add_scan(catalog, "further").scan_id


def made(catalog: Catalog) -> tuple[int, ...]:
    """How many maps, versions, surveys, jobs and scans there are."""
    maps = catalog.maps.page().items
    versions = sum(len(catalog.versions.page(one.map_id).items) for one in maps)
    surveys = sum(len(catalog.surveys.page(one.map_id).items) for one in maps)
    return len(maps), versions, surveys, len(catalog.jobs.page().items), len(catalog.scans.page().items)


def failed_job(catalog: Catalog) -> str:
    _, job_id = add_survey(catalog, ready=False)
    catalog.jobs.fail(job_id, Problem(code="internal", detail="a fault"))
    return job_id


def sends(client: TestClient, catalog: Catalog, scan_id: str) -> dict[str, Send]:
    """One request of every route that makes something."""
    job_id = failed_job(catalog)
    body = {"scan_ids": [scan_id]}

    def posts(path: str, **request: Any) -> Send:
        headers = {**KEY, **request.pop("headers", {})}
        return lambda: client.post(path, headers=headers, **request)

    files = {"scans": ("a.ply", ply("new"), "application/octet-stream")}
    return {
        "scan": posts("/scans", content=ply("raw"), headers=RAW, params={"filename": "a.ply"}),
        "map": posts("/maps", json=body),
        "map of files": posts("/maps", files=files, data={"name": "of files"}),
        "version": posts("/maps/lobby/versions", json=body),
        "survey": posts("/maps/lobby/surveys", json=body),
        "model": posts("/maps/lobby/models", json={}),
        "retry": posts(f"/jobs/{job_id}/retry"),
    }


ROUTES = ("scan", "map", "map of files", "version", "survey", "model", "retry")


@pytest.mark.parametrize("route", ROUTES)
def test_the_first_answer_is_given_again_and_nothing_is_made_twice(
    client: TestClient, catalog: Catalog, lobby: str, route: str
) -> None:
    send = sends(client, catalog, lobby)[route]
    first = send()
    assert first.status_code in (201, 202), first.text
    there = made(catalog)
    again = send()
    assert (again.status_code, again.json()) == (first.status_code, first.json())
    assert again.headers["Location"] == first.headers["Location"]
    assert again.headers[REPLAYED] == "true"
    assert REPLAYED not in first.headers
    assert made(catalog) == there


def test_every_route_that_makes_something_takes_a_key(client: TestClient) -> None:
    document: Any = client.app.openapi()  # type: ignore[attr-defined]
    for method, path in SCOPES:
        if method == "POST" and path not in MAKE_NOTHING:
            names = [one["name"] for one in document["paths"][path]["post"].get("parameters", ())]
            assert "Idempotency-Key" in names, path


def test_the_same_key_with_another_body_is_refused_and_makes_nothing(
    client: TestClient, catalog: Catalog, lobby: str
) -> None:
    client.post("/maps", json={"scan_ids": [lobby]}, headers=KEY)
    there = made(catalog)
    answer = client.post("/maps", json={"scan_ids": [lobby], "name": "another"}, headers=KEY)
    assert answer.status_code == 422
    assert answer.json()["type"] == "urn:spicd:problem:idempotency_key_reused"
    assert made(catalog) == there


def test_a_body_that_says_the_same_in_other_letters_is_the_same_request(
    client: TestClient, lobby: str
) -> None:
    spaced = f'{{"name": "hall",   "scan_ids": ["{lobby}"]}}'
    turned = f'{{"scan_ids":["{lobby}"],"name":"hall"}}'
    headers = {**KEY, "Content-Type": "application/json"}
    first, again = (client.post("/maps", content=text, headers=headers) for text in (spaced, turned))
    assert again.json() == first.json()


def test_a_file_of_another_content_is_another_request(client: TestClient) -> None:
    send = {"params": {"filename": "a.ply"}, "headers": {**KEY, **RAW}}
    assert client.post("/scans", content=ply("one"), **send).status_code == 201
    assert client.post("/scans", content=ply("two"), **send).status_code == 422


def test_a_key_is_of_one_route_and_of_one_thing(client: TestClient, catalog: Catalog, lobby: str) -> None:
    add_map(catalog, "hall")
    body = {"scan_ids": [lobby]}
    assert client.post("/maps/lobby/surveys", json=body, headers=KEY).status_code == 202
    assert client.post("/maps/lobby/versions", json=body, headers=KEY).status_code == 202
    assert client.post("/maps/hall/surveys", json=body, headers=KEY).status_code == 422


def test_a_refused_request_is_not_remembered(client: TestClient, catalog: Catalog) -> None:
    content = ply("late")
    body = {"scan_ids": ["scan-of-later"]}
    assert client.post("/maps", json=body, headers=KEY).status_code == 404
    scan_id = client.post("/scans", content=content, headers=RAW).json()["scan_id"]
    answer = client.post("/maps", json={"scan_ids": [scan_id]}, headers=KEY)
    assert answer.status_code == 202
    assert made(catalog)[0] == 1


@pytest.mark.parametrize("text", ['"', '"a', "a b", '"a"b', "é".encode().decode("latin-1"), "a" * 256, ""])
def test_a_key_that_cannot_be_read_is_refused(client: TestClient, lobby: str, text: str) -> None:
    headers = {"Idempotency-Key": text.encode("latin-1")}
    answer = client.post("/maps", json={"scan_ids": [lobby]}, headers=headers)
    assert answer.status_code == 400
    assert answer.json()["type"] == "urn:spicd:problem:idempotency_key_malformed"


def test_a_key_reads_the_same_with_quotes_and_without() -> None:
    assert read_key('"a-1"') == read_key("a-1") == "a-1"
    assert read_key(r'"a\"b\\ c"') == r'a"b\ c'
    with pytest.raises(KeyMalformed):
        read_key('"a\n"')


def test_ten_equal_requests_at_once_make_one_survey(client: TestClient, catalog: Catalog, lobby: str) -> None:
    start = threading.Barrier(10)

    def send(_: int) -> httpx.Response:
        start.wait()
        files = {"scans": ("a.ply", ply("new"), "application/octet-stream")}
        return client.post("/maps/lobby/surveys", files=files, headers=KEY)

    with ThreadPoolExecutor(10) as threads:
        answers = list(threads.map(send, range(10)))
    assert {answer.status_code for answer in answers} <= {202, 409}
    for answer in answers:
        if answer.status_code == 409:
            assert answer.json()["type"] == "urn:spicd:problem:idempotency_key_in_use"
            assert int(answer.headers["Retry-After"]) > 0
    accepted = {answer.json()["survey_id"] for answer in answers if answer.status_code == 202}
    assert len(accepted) == 1
    assert [one.survey_id for one in catalog.surveys.page("lobby").items] == [*accepted]


class Killed(Exception):
    """The process ended here; a real end would take the server of the test with it."""


@contextmanager
def killed(monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> Iterator[None]:
    """While the block lasts, end at the call of a method, without anything that would tidy up in the catalog."""

    def end(*_: object, **__: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, end)
        yield


def in_a_process_that_ends(send: Send) -> None:
    assert send().status_code == 500


def test_a_kill_before_the_commit_leaves_nothing_and_the_next_request_makes_it(
    client: TestClient, catalog: Catalog, lobby: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = sends(client, catalog, lobby)["survey"]
    there = made(catalog)
    with killed(monkeypatch, idempotency.OnceByKey, "keep"):
        in_a_process_that_ends(send)
    assert made(catalog) == there
    assert send().status_code == 202
    assert made(catalog)[2] == there[2] + 1


@pytest.mark.parametrize("route", ["map", "version", "survey", "model"])
def test_a_kill_behind_the_commit_leaves_one_thing_and_its_first_answer(
    client: TestClient, catalog: Catalog, lobby: str, monkeypatch: pytest.MonkeyPatch, route: str
) -> None:
    send = sends(client, catalog, lobby)[route]
    with killed(monkeypatch, idempotency.OnceByKey, "settle"):
        in_a_process_that_ends(send)
    there = made(catalog)
    under_way = send()
    assert under_way.status_code == 409
    assert under_way.headers["Retry-After"]
    monkeypatch.setattr(idempotency, "UNDER_WAY", timedelta(0))
    first = send()
    assert first.status_code == 202
    assert catalog.jobs.get(first.json()["job_id"]).status == "accepted"
    assert made(catalog) == there
    assert send().json() == first.json()


def test_a_kill_while_it_is_taken_back_leaves_a_key_that_makes_it_again(
    client: TestClient, catalog: Catalog, queue: RememberingQueue, lobby: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = sends(client, catalog, lobby)["map"]
    there = made(catalog)
    queue.down = True
    with killed(monkeypatch, idempotency.OnceByKey, "drop"):
        in_a_process_that_ends(send)
    queue.down = False
    assert made(catalog) == there
    monkeypatch.setattr(idempotency, "UNDER_WAY", timedelta(0))
    assert send().status_code == 202
    assert made(catalog)[0] == there[0] + 1


def test_a_request_that_the_queue_refused_may_come_again(
    client: TestClient, catalog: Catalog, queue: RememberingQueue, lobby: str
) -> None:
    send = sends(client, catalog, lobby)["survey"]
    queue.down = True
    assert send().status_code == 503
    queue.down = False
    assert send().status_code == 202


def test_a_job_that_failed_again_is_not_run_by_the_same_retry(
    client: TestClient, catalog: Catalog, lobby: str
) -> None:
    send = sends(client, catalog, lobby)["retry"]
    job_id = send().json()["jobID"]
    catalog.jobs.fail(job_id, Problem(code="internal", detail="the same fault"))
    assert send().status_code == 202
    assert catalog.jobs.get(job_id).status == "failed"


def test_a_full_queue_refuses_new_requests_and_not_those_that_were_taken(
    client: TestClient, catalog: Catalog, lobby: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = sends(client, catalog, lobby)["map"]
    first = send()
    monkeypatch.setattr(type(catalog.jobs), "waiting", lambda *_: 10**6)
    assert send().json() == first.json()
    assert client.post("/maps", json={"scan_ids": [lobby]}).status_code == 429


def test_keys_are_kept_for_a_day_and_then_swept(
    client: TestClient, catalog: Catalog, settings: Settings, lobby: str
) -> None:
    send = sends(client, catalog, lobby)["map"]
    send()
    there = made(catalog)

    def sweep(hours: float) -> None:
        with catalog.database.write() as session:
            session.execute(update(IdempotencyKey).values(created=now() - timedelta(hours=hours)))
        retention.remove(catalog, retention.policy_of(settings, now()), retention.Leftovers())

    sweep(23.9)
    send()
    assert made(catalog) == there
    sweep(24.1)
    send()
    assert made(catalog)[0] == there[0] + 1
