"""Pages of other sites: what a browser sends for them is refused, and what it may show of ours is said."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError

from service.api.http.guards.cross_site import allowed_hosts, answers_to
from service.settings import Settings
from tests.support.samples import RememberingQueue, catalog_of, ply, running, settings_in

DASHBOARD = "https://dash.example.org"
FORM = {"file": ("hall.ply", ply())}


@pytest.fixture
def named(tmp_path: Path) -> Iterator[TestClient]:
    """A service that knows one dashboard."""
    settings = settings_in(tmp_path).model_copy(update={"allowed_origins": DASHBOARD})
    with running(settings, RememberingQueue()) as client:
        yield client


def refused(answer: httpx.Response) -> bool:
    return answer.status_code == 403 and answer.json()["type"] == "urn:spicd:problem:forbidden"


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://localhost:3000"},
        {"Origin": "https://evil.example", "Sec-Fetch-Site": "cross-site"},
        {"Origin": "http://app.localhost", "Sec-Fetch-Site": "same-site"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Origin": "https://localhost.evil.example"},
    ],
)
def test_a_form_that_a_foreign_page_sends_changes_nothing(
    client: TestClient, headers: dict[str, str]
) -> None:
    answer = client.post("/scans", files=FORM, headers=headers)
    assert refused(answer), answer.text
    assert not catalog_of(client).scans.page().items
    assert refused(client.delete("/maps/lobby", headers=headers))


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Origin": "http://localhost"},
        {"Origin": "http://localhost", "Sec-Fetch-Site": "same-origin"},
        {"Sec-Fetch-Site": "none"},
    ],
)
def test_programs_and_the_services_own_pages_may_upload(client: TestClient, headers: dict[str, str]) -> None:
    assert client.post("/scans", files=FORM, headers=headers).status_code == 201


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "evil.example:8000", "a b", "[::1", "@"]
)
def test_a_name_that_somebody_else_gave_the_service_is_refused(client: TestClient, host: str) -> None:
    assert refused(client.get("/maps", headers={"Host": host}))


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:8000", "127.0.0.1:8000", "[::1]:8000", "10.1.2.3:8000", "localhost.", ""]
)
def test_loopback_names_and_addresses_are_answered_to(client: TestClient, host: str) -> None:
    assert client.get("/health/live", headers={"Host": host}).status_code == 200


def test_a_wildcard_takes_names_below_it_alone() -> None:
    names = frozenset({"*.example.org"})
    assert answers_to("spicd.example.org", names)
    assert answers_to("a.b.example.org:443", names)
    assert not answers_to("example.org", names)
    assert not answers_to("spicd.example.org.evil.example", names)


@pytest.mark.parametrize(
    ("given", "name", "answered"),
    [
        ({}, "spicd.example.org", False),
        ({"host": "spicd.example.org", "auth": "none"}, "spicd.example.org", True),
        ({"host": "0.0.0.0", "auth": "none"}, "spicd.example.org", False),
        ({"host": "0.0.0.0"}, "spicd.example.org", True),  # a page of another name has no key
        ({"host": "0.0.0.0", "allowed_hosts": "api"}, "spicd.example.org", False),
        ({"allowed_hosts": "api, Spicd.example.org"}, "spicd.example.org", True),
        ({"allowed_hosts": "*"}, "evil.example", True),
    ],
)
def test_the_names_of_the_service_are_those_set_or_those_that_are_safe(
    given: dict[str, str], name: str, answered: bool
) -> None:
    names = allowed_hosts(Settings.model_validate(given))
    assert (names is None or answers_to(name, names)) is answered


@pytest.mark.parametrize(
    ("path", "method", "header"),
    [("/events", "GET", "last-event-id"), ("/webhooks/webhook-1", "PATCH", "content-type")],
)
def test_a_named_dashboard_may_follow_a_stream_and_change_a_webhook(
    named: TestClient, path: str, method: str, header: str
) -> None:
    asked = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": header}
    assert named.options(path, headers={"Origin": DASHBOARD, **asked}).status_code == 200


def test_a_named_dashboard_may_read_and_change(named: TestClient) -> None:
    preflight = named.options(
        "/scans",
        headers={
            "Origin": DASHBOARD,
            "Access-Control-Request-Method": "POST",
            "Access-Control-Request-Headers": "authorization",
        },
    )
    assert preflight.status_code == 200
    assert preflight.headers["Access-Control-Allow-Origin"] == DASHBOARD
    page = {"Origin": DASHBOARD, "Sec-Fetch-Site": "cross-site"}
    answer = named.post("/scans", files=FORM, headers=page)
    assert answer.status_code == 201
    assert answer.headers["Access-Control-Allow-Origin"] == DASHBOARD
    assert "Location" in answer.headers["Access-Control-Expose-Headers"]
    assert "Access-Control-Allow-Credentials" not in answer.headers


@pytest.mark.parametrize(
    ("method", "headers"),
    [
        ("POST", "authorization,content-type,idempotency-key,content-digest,repr-digest,content-encoding"),
        ("GET", "authorization,if-none-match,last-event-id,range,if-range,want-repr-digest"),
        ("PATCH", "content-type,tus-resumable,upload-offset,upload-checksum"),
        ("POST", "tus-resumable,upload-length,upload-metadata"),
        ("HEAD", "tus-resumable"),
        ("DELETE", "tus-resumable"),
        ("PUT", "if-match,x-request-id"),
    ],
)
def test_a_named_dashboard_may_send_the_headers_that_the_api_knows(
    named: TestClient, method: str, headers: str
) -> None:
    asked = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": headers}
    preflight = named.options("/scans", headers={"Origin": DASHBOARD, **asked})
    assert preflight.status_code == 200, preflight.text
    assert method in preflight.headers["Access-Control-Allow-Methods"]
    refused = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": "x-unheard-of"}
    assert named.options("/scans", headers={"Origin": DASHBOARD, **refused}).status_code == 400


def test_a_named_dashboard_may_read_the_headers_that_the_api_answers_with(named: TestClient) -> None:
    answer = named.get("/maps", headers={"Origin": DASHBOARD})
    exposed = {name.strip() for name in answer.headers["Access-Control-Expose-Headers"].split(",")}
    assert exposed >= {"Location", "ETag", "Retry-After", "Link", "Allow", "Content-Range", "Repr-Digest"}
    assert exposed >= {"Tus-Resumable", "Upload-Offset", "Upload-Expires", "Accept-Encoding"}


def test_caches_keep_answers_to_pages_apart(named: TestClient) -> None:
    for headers in ({}, {"Origin": DASHBOARD}, {"Origin": "https://evil.example"}):
        vary = [name.strip() for name in named.get("/maps", headers=headers).headers["Vary"].split(",")]
        assert vary.count("Origin") == 1


def test_where_no_origin_is_named_no_answer_depends_on_it(client: TestClient) -> None:
    assert "Origin" not in client.get("/maps").headers.get("Vary", "")


def test_a_page_of_another_origin_may_not_even_read(named: TestClient) -> None:
    answer = named.get("/maps", headers={"Origin": "https://evil.example"})
    assert "Access-Control-Allow-Origin" not in answer.headers
    assert refused(named.post("/scans", files=FORM, headers={"Origin": "https://evil.example"}))


@pytest.mark.parametrize("origins", ["*", "dash.example.org", "https://dash.example.org/path", "null"])
def test_what_is_no_origin_is_not_taken_for_one(origins: str) -> None:
    with pytest.raises(ValidationError, match="is no origin"):
        Settings(allowed_origins=origins)
