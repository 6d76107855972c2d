"""Behind a path prefix: every link leads somewhere, whether what is in front takes the prefix off or not."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from service.api import app
from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.webhooks.sending import Sender
from tests.support.samples import (
    RememberingQueue,
    add_map,
    add_survey,
    add_version,
    catalog_of,
    place,
    ply,
    running,
    settings_in,
    thing,
    tile,
)

PREFIX = "/spicd"
Ask = Callable[..., httpx.Response]


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service under a prefix that holds one of everything."""
    settings = settings_in(Path(tmp_path_factory.mktemp("prefix"))).model_copy(update={"root_path": PREFIX})
    with running(settings, RememberingQueue()) as opened:
        fill(catalog_of(opened))
        yield opened


def fill(catalog: Catalog) -> None:
    jobs = [add_map(catalog), add_version(catalog)]
    for job_id in jobs:
        catalog.blobs.put_bytes(blob_keys.map_cloud(job_id), ply())
        catalog.blobs.put_bytes(blob_keys.map_laz(job_id), b"LASF")
        catalog.blobs.put_bytes(blob_keys.map_manifest(job_id), b"{}")
    told, _ = add_survey(catalog, [tile(i, 0) for i in range(3)], objects=[thing(1, now=place(1, 1))])
    catalog.blobs.put_bytes(blob_keys.survey_cloud(told), ply())
    catalog.blobs.put_bytes(blob_keys.survey_laz(told), b"LASF")
    catalog.blobs.put_bytes(blob_keys.survey_picture(told), b"\x89PNG")
    add_version(catalog, ready=False)
    for number in range(3):
        add_map(catalog, f"further-{number}", ready=False)


@pytest.fixture(params=["kept", "taken off"])
def ask(request: pytest.FixtureRequest, client: TestClient) -> Ask:
    """Asks as a browser would; the proxy in front keeps the prefix, or takes it off."""

    def asked(method: str, href: str, **given: Any) -> httpx.Response:
        assert href.startswith(f"{PREFIX}/"), href
        sent = href if request.param == "kept" else href.removeprefix(PREFIX)
        return client.request(method, sent, follow_redirects=False, **given)

    return asked


def hrefs(node: object) -> set[str]:
    if isinstance(node, dict):
        own = {node["href"]} if isinstance(node.get("href"), str) else set()
        own = set() if node.get("rel") == "profile" else own  # the name of a profile, in no place of ours
        return own.union(*(hrefs(value) for value in node.values()))
    if isinstance(node, list):
        return set().union(*(hrefs(value) for value in node))
    return set()


def test_every_link_from_the_landing_page_on_leads_somewhere(ask: Ask) -> None:
    waiting, seen = [f"{PREFIX}/", f"{PREFIX}/maps?limit=1", f"{PREFIX}/jobs?limit=2"], set[str]()
    while waiting:
        href = waiting.pop()
        if href in seen:
            continue
        seen.add(href)
        answer = ask("GET", href)
        running_job = answer.status_code == 404 and "result-not-ready" in answer.text
        assert answer.status_code == 200 or running_job or href.endswith("/health/ready"), (href, answer.text)
        if "json" in answer.headers["Content-Type"] and not href.endswith("openapi.json"):
            waiting += hrefs(answer.json())
    for part in (
        "/maps/lobby/changes",
        "/maps/lobby/objects",
        "/surveys/",
        "/versions/2",
        "cursor=",
        "/results",
    ):
        assert any(part in href for href in seen), part
    assert len(seen) > 40


def test_next_links_of_features_bear_the_prefix(ask: Ask) -> None:
    page = ask("GET", f"{PREFIX}/maps/lobby/changes?limit=1").json()
    links = {link["rel"]: link["href"] for link in page["links"]}
    assert links["self"] == f"{PREFIX}/maps/lobby/changes?limit=1"
    assert ask("GET", links["next"]).json()["numberReturned"] == 1


def test_the_place_of_what_was_made_bears_the_prefix(ask: Ask) -> None:
    raw = {"Content-Type": "application/octet-stream"}
    scan = ask("POST", f"{PREFIX}/scans", content=ply("new"), headers=raw)
    assert ask("GET", scan.headers["Location"]).json()["scan_id"] == scan.json()["scan_id"]
    accepted = ask("POST", f"{PREFIX}/maps", json={"scan_ids": [scan.json()["scan_id"]]})
    assert accepted.status_code == 202
    assert accepted.headers["Retry-After"].isdigit()
    assert ask("GET", accepted.headers["Location"]).json()["jobID"] == accepted.json()["job_id"]
    assert ask("DELETE", accepted.headers["Location"]).status_code == 200


def test_the_description_and_the_pages_know_where_they_are(ask: Ask) -> None:
    assert ask("GET", f"{PREFIX}/openapi.json").json()["servers"] == [{"url": PREFIX}]
    for page in ("/docs", "/redoc"):
        text = ask("GET", PREFIX + page).text
        assert f"{PREFIX}/openapi.json" in text
        for source in re.findall(r'(?:src|href)="(/[^"]+)"', text):
            assert ask("GET", source).status_code == 200


def test_methods_and_unknown_paths_are_told_under_a_prefix_too(client: TestClient) -> None:
    assert client.options(f"{PREFIX}/maps").headers["Allow"] == "GET, HEAD, POST, OPTIONS"
    assert client.head(f"{PREFIX}/maps").status_code == 200
    assert client.get(PREFIX).status_code == 200
    for path in (f"{PREFIX}/nowhere", "/spicdx/maps", f"{PREFIX}{PREFIX}/maps"):
        assert client.get(path).status_code == 404


def test_webhooks_are_sent_links_that_bear_the_prefix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    def sender(**options: Any) -> Sender:
        given.update(options)
        return Sender(**options)

    monkeypatch.setattr(app, "Sender", sender)
    settings = settings_in(tmp_path).model_copy(update={"root_path": "/spicd"})
    with running(settings, RememberingQueue()):
        assert given["root"] == "/spicd"
