"""The viewer's page and its files: who gets it, under which policy, and how long it is kept."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient

from tests.support.samples import RememberingQueue, running, settings_in

#: What browsers send for an address that somebody types (Fetch Standard, "document").
BROWSER = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,image/avif,*/*;q=0.8"}
PAGE = '<!doctype html><base href="/" /><script type="module" src="web/main-ABCD2345.js"></script>'
SCRIPT = "export const scene = 1;\n" * 100
FOR_EVER = "public, max-age=31536000, immutable"


@pytest.fixture
def built(tmp_path: Path) -> Path:
    """A bundle as `make web` leaves it."""
    folder = tmp_path / "built"
    folder.mkdir()
    (folder / "index.html").write_text(PAGE)
    (folder / "main-ABCD2345.js").write_text(SCRIPT)
    (folder / "main-ABCD2345.css").write_text("body { margin: 0 }")
    (folder / "licences.txt").write_text("three 0.187.0 (MIT)")
    (folder / "notes.py").write_text("secret")
    return folder


@pytest.fixture
def client(tmp_path: Path, built: Path) -> Iterator[TestClient]:
    with running(settings_in(tmp_path), RememberingQueue()) as opened:
        opened.app.state.viewer = built  # type: ignore[attr-defined]
        yield opened


def policy_of(answer: httpx.Response) -> dict[str, list[str]]:
    """The directives of a Content-Security-Policy, with their sources."""
    directives = (words.split() for words in answer.headers["content-security-policy"].split(";"))
    return {name: sources for name, *sources in directives}


def test_a_browser_gets_the_page_and_every_other_client_the_document(client: TestClient) -> None:
    assert client.get("/", headers=BROWSER).text == PAGE
    for accept in (
        "*/*",
        "application/json",
        "text/plain, */*",
        "text/html;q=0.5, application/json",
        "image/png",
    ):
        answer = client.get("/", headers={"Accept": accept})
        assert answer.headers["content-type"] == "application/json"
        assert answer.json()["title"] == "SPICD"


def test_a_cache_is_told_that_both_have_the_same_address(client: TestClient) -> None:
    for headers in (BROWSER, {}):
        assert "Accept" in client.get("/", headers=headers).headers["vary"].split(", ")


def test_the_page_may_load_and_ask_of_this_service_alone(client: TestClient) -> None:
    policy = policy_of(client.get("/", headers=BROWSER))
    assert policy["default-src"] == ["'none'"]
    for name in ("script-src", "style-src", "connect-src", "worker-src", "base-uri", "frame-ancestors"):
        assert policy[name] == ["'self'"], name
    assert policy["img-src"] == ["'self'", "data:", "blob:"]
    assert policy["form-action"] == ["'none'"]
    assert "unsafe" not in client.get("/", headers=BROWSER).headers["content-security-policy"]


def test_dashboards_of_the_named_origins_may_show_the_page_in_a_frame(tmp_path: Path) -> None:
    origins = "https://dash.example.org, http://10.0.0.7:3000"
    settings = settings_in(tmp_path).model_copy(update={"allowed_origins": origins})
    with running(settings, RememberingQueue()) as opened:
        ancestors = policy_of(opened.get("/", headers=BROWSER))["frame-ancestors"]
    assert ancestors == ["'self'", "https://dash.example.org", "http://10.0.0.7:3000"]


def test_the_page_is_asked_for_anew_each_time_and_answered_304_where_it_is_the_same(
    client: TestClient,
) -> None:
    first = client.get("/", headers=BROWSER)
    assert first.headers["cache-control"] == "no-cache"
    again = client.get("/", headers=BROWSER | {"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert (
        client.get("/", headers={"If-None-Match": first.headers["etag"]}).status_code == 200
    )  # the document


def test_a_head_of_the_page_tells_what_a_get_would(client: TestClient) -> None:
    head, get = client.head("/", headers=BROWSER), client.get("/", headers=BROWSER)
    assert (head.status_code, head.content) == (200, b"")
    for name in ("content-type", "content-length", "etag", "content-security-policy", "cache-control"):
        assert head.headers[name] == get.headers[name]


def test_what_the_page_loads_is_kept_for_ever_and_packed(client: TestClient) -> None:
    answer = client.get("/web/main-ABCD2345.js")
    assert answer.text == SCRIPT
    assert answer.headers["cache-control"] == FOR_EVER
    assert answer.headers["content-type"].startswith("text/javascript")
    assert answer.headers["content-encoding"] == "gzip"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert client.get("/web/main-ABCD2345.css").headers["content-type"].startswith("text/css")
    known = client.get("/web/main-ABCD2345.js", headers={"If-None-Match": answer.headers["etag"]})
    assert (known.status_code, known.content) == (304, b"")


def test_a_file_without_a_hash_in_its_name_is_asked_for_anew(client: TestClient) -> None:
    assert client.get("/web/licences.txt").headers["cache-control"] == "no-cache"


def test_a_head_of_a_file_reads_nothing_of_it(client: TestClient) -> None:
    answer = client.head("/web/main-ABCD2345.js", headers={"Accept-Encoding": "identity"})
    assert (answer.status_code, answer.content) == (200, b"")
    assert answer.headers["content-length"] == str(len(SCRIPT))


@pytest.mark.parametrize(
    "name",
    [
        "index.html",
        "notes.py",
        "main-ZZZZ9999.js",
        "..%2Fpages.py",
        "%2e%2e/index.html",
        "",
        "main-ABCD2345.js/x",
    ],
)
def test_nothing_but_the_bundle_is_found_there(client: TestClient, name: str) -> None:
    assert client.get(f"/web/{name}").status_code == 404


def test_without_a_bundle_the_page_says_how_to_make_it(client: TestClient, tmp_path: Path) -> None:
    client.app.state.viewer = tmp_path / "nothing"  # type: ignore[attr-defined]
    answer = client.get("/", headers=BROWSER)
    assert answer.status_code == 200
    assert "make web" in answer.text
    assert "<script" not in answer.text
    assert client.get("/web/main-ABCD2345.js").status_code == 404


def test_the_page_is_public_also_where_keys_are_needed_and_data_are_not(tmp_path: Path, built: Path) -> None:
    settings = settings_in(tmp_path).model_copy(update={"auth": "required"})
    with running(settings, RememberingQueue()) as opened:
        opened.app.state.viewer = built  # type: ignore[attr-defined]
        assert opened.get("/", headers=BROWSER).text == PAGE
        assert opened.get("/web/main-ABCD2345.js").status_code == 200
        assert opened.get("/maps").status_code == 401


@pytest.mark.parametrize("path", ["/", "/spicd", "/spicd/"])
def test_behind_a_prefix_the_page_loads_from_under_it(tmp_path: Path, built: Path, path: str) -> None:
    settings = settings_in(tmp_path).model_copy(update={"root_path": "/spicd"})
    with running(settings, RememberingQueue()) as opened:
        opened.app.state.viewer = built  # type: ignore[attr-defined]
        page = opened.get(path, headers=BROWSER).text
        assert '<base href="/spicd/" />' in page
        (script,) = re.findall(r'src="([^"]+)"', page)
        assert opened.get(f"/spicd/{script}").text == SCRIPT


def test_a_parameter_that_the_page_does_not_know_is_refused(client: TestClient) -> None:
    assert client.get("/?map=hall", headers=BROWSER).status_code == 422
