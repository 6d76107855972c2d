"""Problems: every error of every documented route is a problem document with its type."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast

import httpx
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.api.http.answering.problems import MEDIA_TYPE, PROBLEMS
from service.catalog.catalog import Catalog
from service.catalog.maps import Maps
from service.errors import (
    BlobsUnavailable,
    DatabaseUnavailable,
    DiskFull,
    NotFound,
    QueueFull,
    QueueUnavailable,
    ServiceError,
)
from tests.support.samples import (
    MODEL,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    catalog_of,
    ply,
    running,
    services_of,
    settings_in,
)

RAW = {"Content-Type": "application/octet-stream"}
JSON = {"Content-Type": "application/json"}
FORM = {"Content-Type": "multipart/form-data; boundary=b"}


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service with a map that is ready and one that is not, for requests that change nothing."""
    with running(settings_in(tmp_path_factory.mktemp("service")), RememberingQueue()) as client:
        add_map(catalog_of(client), "ready")
        add_map(catalog_of(client), "building", ready=False)
        yield client


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == MEDIA_TYPE
    body: dict[str, Any] = answer.json()
    assert body["type"] == f"urn:spicd:problem:{code}"
    assert body["status"] == status
    assert body["title"] and body["detail"]
    return body


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/nowhere", 404, "not_found"),
        ("GET", "/scans/none", 404, "not_found"),
        ("DELETE", "/scans/none", 404, "not_found"),
        ("GET", "/maps/none", 404, "not_found"),
        ("DELETE", "/maps/none", 404, "not_found"),
        ("GET", "/maps/none/manifest", 404, "not_found"),
        ("GET", "/maps/none/cloud.ply", 404, "not_found"),
        ("GET", "/maps/none/surveys", 404, "not_found"),
        ("POST", "/maps/none/surveys", 404, "not_found"),
        ("GET", "/maps/none/changes", 404, "not_found"),
        ("GET", "/surveys/none", 404, "not_found"),
        ("DELETE", "/surveys/none", 404, "not_found"),
        ("GET", "/surveys/none/tiles", 404, "not_found"),
        ("GET", "/surveys/none/cloud.ply", 404, "not_found"),
        ("GET", "/surveys/none/picture.png", 404, "not_found"),
        ("GET", "/jobs/none", 404, "not_found"),
        ("DELETE", "/jobs/none", 404, "not_found"),
        ("GET", "/models/none", 404, "not_found"),
        ("GET", "/models/spicd-net?version=9", 404, "not_found"),
        ("GET", "/maps/building/manifest", 409, "not_ready"),
        ("GET", "/maps/building/cloud.ply", 409, "not_ready"),
        ("GET", "/maps/building/changes", 409, "not_ready"),
        ("POST", "/maps/building/surveys", 409, "not_ready"),
        ("GET", "/maps/ready/cloud.ply", 404, "not_found"),
        ("PUT", "/maps/ready", 405, "method_not_allowed"),
        ("POST", "/scans", 415, "wrong_media_type"),
        ("POST", "/maps", 415, "wrong_media_type"),
        ("POST", "/maps/ready/surveys", 415, "wrong_media_type"),
        ("GET", "/scans?limit=0", 422, "invalid_request"),
        ("GET", "/scans?cursor=x", 422, "bad_request"),
        ("GET", "/maps?limit=many", 422, "invalid_request"),
        ("GET", "/jobs?status=lost", 422, "invalid_request"),
        ("GET", "/maps/ready/surveys?offset=3", 422, "invalid_request"),
        ("GET", "/maps/not%20an%20id", 422, "invalid_request"),
        ("GET", "/models/a%20b", 422, "invalid_request"),
    ],
)
def test_a_request_without_a_body_ends_in_its_problem(
    asked: TestClient, method: str, path: str, status: Any, code: str
) -> None:
    problem(asked.request(method, path), status, code)


@pytest.mark.parametrize(
    ("headers", "body", "status", "code"),
    [
        (RAW, b"ply\n", 415, "wrong_media_type"),
        ({"Content-Type": "text/plain"}, b"{}", 415, "wrong_media_type"),
        (JSON, b"", 422, "bad_request"),
        (JSON, b"{", 422, "bad_request"),
        (JSON, b"[]", 422, "bad_request"),
        (JSON, b"[" * 100_000, 422, "bad_request"),
        (JSON, b'"\xff"', 422, "bad_request"),
        (JSON, b"{}", 422, "bad_request"),
        (JSON, b" " * 1_100_000, 413, "too_large"),
        (JSON, b'{"scan_ids": ["\\ud800"]}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["a"], "\\ud800": 1}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["a"], "device_id": "a\\u0000"}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["a"], "device_id": "\\udfff"}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["a"], "captured_at": "0001-01-01T00:00:00+14:00"}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["none"]}', 404, "not_found"),
        (JSON, b'{"scan_ids": 3}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["a", "a"]}', 422, "bad_request"),
        (JSON, b'{"scan_ids": ["../a"]}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["a"], "model": "other/3"}', 422, "bad_request"),
        (JSON, b'{"scan_ids": ["a"], "model": "../x"}', 422, "invalid_request"),
        (JSON, b'{"scan_ids": ["a"], "colour": "red"}', 422, "invalid_request"),
        ({"Content-Type": "multipart/form-data"}, b"", 422, "bad_request"),
        (FORM, b"", 422, "bad_request"),
        (FORM, b"no form at all", 422, "bad_request"),
        (FORM, b"--b\r\n\r\nx\r\n--b--\r\n", 422, "bad_request"),
        (
            FORM,
            b'--b\r\nContent-Disposition: form-data; name="scans"\r\n\r\n\r\n--b--\r\n',
            422,
            "scan_unreadable",
        ),
    ],
)
@pytest.mark.parametrize("path", ["/maps", "/maps/ready/surveys"])
def test_a_body_that_does_not_match_ends_in_its_problem(
    asked: TestClient, path: str, headers: dict[str, str], body: Any, status: Any, code: str
) -> None:
    problem(asked.post(path, content=body, headers=headers), status, code)


@pytest.mark.parametrize(
    ("fields", "place", "value"),
    [
        ({"id": "no spaces"}, "body.id", "no spaces"),
        ({"id": ""}, "body.id", ""),
        ({"id": "x" * 65}, "body.id", "x" * 65),
        ({"settings": {"voxel_size": 0.1}}, "body.settings.voxel_size", 0.1),
        ({"settings": {"tile_size": [1, 1, 1]}}, "body.settings.tile_size", "[1, 1, 1]"),
        ({"settings": {"alarms_per_survey": 0}}, "body.settings.alarms_per_survey", 0),
        (
            {"settings": {"registration": {"min_fitness": 1.5}}},
            "body.settings.registration.min_fitness",
            1.5,
        ),
        (
            {"settings": {"registration": {"max_inlier_rmse": 0}}},
            "body.settings.registration.max_inlier_rmse",
            0,
        ),
        ({"captured_at": "yesterday"}, "body.captured_at", "yesterday"),
        ({"name": "n" * 201}, "body.name", "n" * 200 + "..."),
    ],
)
def test_a_field_that_does_not_match_is_named_with_its_value(
    asked: TestClient, fields: dict[str, Any], place: str, value: object
) -> None:
    answer = asked.post("/maps", json={"scan_ids": [add_scan(catalog_of(asked)).scan_id], **fields})
    errors = problem(answer, 422, "invalid_request")["errors"]
    assert [(error["place"], error["value"]) for error in errors] == [(place, value)]


@pytest.mark.parametrize("threshold", ["-0.1", "1.1", "NaN", "high"])
def test_a_threshold_is_a_probability(asked: TestClient, threshold: float) -> None:
    answer = asked.post(
        "/maps/ready/surveys", data={"threshold": threshold}, files={"scans": ("a.ply", ply())}
    )
    assert problem(answer, 422, "invalid_request")["errors"][0]["place"] == "body.threshold"


def test_what_is_in_the_way_is_a_conflict(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog)
    used = catalog.maps.get("lobby").scans[0].scan_id
    taken = client.post("/maps", json={"id": "lobby", "scan_ids": [used]})
    assert "lobby" in problem(taken, 409, "conflict")["detail"]
    problem(client.delete(f"/scans/{used}"), 409, "conflict")
    problem(client.delete(f"/jobs/{job_id}"), 409, "conflict")


def test_an_unexpected_error_tells_nothing_of_the_inside(
    client: TestClient, catalog: Catalog, caplog: pytest.LogCaptureFixture
) -> None:
    catalog.database.engine.dispose()
    services = services_of(client)

    class Broken:
        def page(self, **_: object) -> None:
            raise RuntimeError("postgresql://user:secret@host")

    broken = replace(services.catalog, maps=cast("Maps", Broken()))
    cast("FastAPI", client.app).state.services = replace(services, catalog=broken)
    answer = client.get("/maps")
    body = problem(answer, 500, "internal")
    assert "secret" not in answer.text
    assert body["instance"].startswith("urn:uuid:")
    assert body["instance"] in caplog.text


def test_a_405_says_what_is_allowed(client: TestClient) -> None:
    assert "GET" in client.put("/maps/lobby").headers["allow"]


def test_every_error_of_the_service_has_its_place_in_the_table() -> None:
    codes = {kind.code for kind in ServiceError.__subclasses__()}
    assert codes <= set(PROBLEMS)
    assert all(PROBLEMS[code][0] is not None for code in codes)


def every_kind_of(error: type) -> list[type]:
    """Return its subclasses, and theirs."""
    direct: list[type] = error.__subclasses__()
    return [*direct, *(further for kind in direct for further in every_kind_of(kind))]


def test_every_error_of_the_pipeline_has_a_title() -> None:
    errors = pytest.importorskip("worker.errors")
    kinds: list[Any] = [errors.PipelineError, *every_kind_of(errors.PipelineError)]
    assert {kind.code for kind in kinds} - {"cancelled"} <= set(PROBLEMS)


def test_a_problem_of_a_survey_that_ran_is_no_problem_of_the_request(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    catalog.jobs.dismiss(job_id)
    answer = client.get(f"/surveys/{survey_id}")
    assert (answer.status_code, answer.json()["problem"]["type"]) == (200, "urn:spicd:problem:dismissed")
    assert answer.json()["model"] == MODEL


@pytest.mark.parametrize(
    ("error", "status", "wait"),
    [
        (QueueUnavailable("x"), 503, "5"),
        (DatabaseUnavailable("x"), 503, "5"),
        (BlobsUnavailable("x"), 503, "5"),
        (QueueFull("x"), 429, "30"),
        (DiskFull("x"), 507, None),
        (NotFound("x"), 404, None),
    ],
)
def test_who_may_come_again_is_told_when(
    client: TestClient,
    catalog: Catalog,
    monkeypatch: pytest.MonkeyPatch,
    error: ServiceError,
    status: int,
    wait: str,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(Maps, "page", fail)
    answer = client.get("/maps")
    problem(answer, status, error.code)
    assert answer.headers.get("Retry-After") == wait


def test_a_queue_whose_disk_is_full_is_a_full_disk(
    client: TestClient, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        cause = RuntimeError("MISCONF Errors writing to the AOF file: No space left on device")
        raise QueueUnavailable("the job queue does not answer") from cause

    monkeypatch.setattr(Maps, "page", fail)
    problem(client.get("/maps"), 507, "disk_full")


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_an_address_with_a_slash_too_many_is_none_and_leads_nowhere(client: TestClient, method: str) -> None:
    answer = client.request(method, "/maps/", headers={"Host": "127.0.0.1"}, follow_redirects=False)
    assert (answer.status_code, answer.json()["type"]) == (404, "urn:spicd:problem:not_found")
    assert "location" not in answer.headers


def test_a_field_that_is_not_known_is_answered_with_those_that_are(client: TestClient) -> None:
    asked = {"uri": "https://example.org/", "url": "https://example.org/"}
    answer = problem(client.post("/webhooks", json=asked), 422, "invalid_request")
    assert answer["errors"][0]["place"] == "body.uri"
    assert answer["errors"][0]["detail"] == "there is no such field; there are map, types, url"
    use = {"scan_ids": [], "scans": [{"scan_id": "scan-1", "poze": []}]}
    answer = problem(client.post("/maps", json=use), 422, "invalid_request")
    assert answer["errors"][0]["detail"] == "there is no such field"
