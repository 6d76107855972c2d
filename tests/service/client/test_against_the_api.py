"""The client and the API together, behind a network that loses every second answer of what it brought there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest

from service.catalog.catalog import Catalog
from service.client import AsyncClient, Client, RequestRefused, Retries
from tests.support.samples import (
    MODEL,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    catalog_of,
    ply,
    running,
    settings_in,
    tile,
)

QUICK = Retries(first_pause_s=0.001)


class Losing(httpx.BaseTransport):
    """Hands every request on to the service, and loses every second answer."""

    def __init__(self, way: httpx.BaseTransport) -> None:
        self.way, self.sent = way, 0

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.sent += 1
        answer = self.way.handle_request(request)
        if self.sent % 2:
            raise httpx.ReadError("the link is gone", request=request)
        return answer


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Client, Catalog, Losing]]:
    monkeypatch.setattr(
        "service.client.retries.FIRST_CONTACT_S", 60.0
    )  # the first answer is lost, however slow
    with running(settings_in(tmp_path), RememberingQueue()) as service:
        losing = Losing(service._transport)
        with Client("http://localhost", transport=losing, retries=QUICK) as client:
            yield client, catalog_of(service), losing


def test_each_thing_is_made_once_though_every_answer_is_lost_at_first(
    parts: tuple[Client, Catalog, Losing],
) -> None:
    client, catalog, losing = parts
    add_map(catalog, "hall")
    scans = [client.upload_scan(ply(name), filename=f"{name}.ply")["scan_id"] for name in "abc"]
    for scan_id in scans:
        client.create_map([scan_id])
        client.submit_survey("hall", [scan_id])
    client.create_version("hall", [scans[0]])  # one builds at a time
    assert losing.sent == 2 * 10
    assert len(catalog.maps.page().items) == 1 + 3
    assert len(catalog.surveys.page("hall").items) == 3
    assert len(catalog.versions.page("hall").items) == 1 + 1
    assert {scan["scan_id"] for scan in client.scans()} > set(scans)


def test_what_is_deleted_is_gone_without_an_error(parts: tuple[Client, Catalog, Losing]) -> None:
    client, catalog, _ = parts
    scan_id = client.upload_scan(ply("alone"))["scan_id"]
    add_map(catalog, "hall")
    survey_id, _ = add_survey(catalog, map_id="hall")
    client.delete_scan(scan_id)
    client.delete_survey(survey_id)
    client.delete_map("hall")
    assert client.maps() == []
    with pytest.raises(RequestRefused, match="hall"):
        client.map("hall")


def test_the_csv_of_changes_is_what_the_service_writes(parts: tuple[Client, Catalog, Losing]) -> None:
    client, catalog, _ = parts
    add_map(catalog, "hall")
    tiles = [tile(number, 0) for number in range(3)]
    add_survey(catalog, tiles, map_id="hall")
    names, *rows = client.changes_csv("hall", limit=1)
    assert {"tile_id", "score", "survey_id"} <= set(names.split(","))
    assert len(rows) == 3 == client.changes("hall")["numberMatched"]


def test_a_key_that_the_caller_keeps_makes_one_thing_in_two_processes(
    parts: tuple[Client, Catalog, Losing],
) -> None:
    client, catalog, _ = parts
    add_map(catalog, "hall")
    scan_id = client.upload_scan(ply("a"))["scan_id"]
    first, again = (client.submit_survey("hall", [scan_id], idempotency_key="visit-7") for _ in range(2))
    assert first == again
    assert len(catalog.surveys.page("hall").items) == 1


def test_a_map_shows_its_first_hundred_scans_and_its_list_all_of_them(
    parts: tuple[Client, Catalog, Losing],
) -> None:
    client, catalog, _ = parts
    ids = [add_scan(catalog, f"scan-{number}").scan_id for number in range(130)]
    catalog.maps.create(scan_ids=ids, model=MODEL, map_id="hall")
    shown, version = client.map("hall"), client.version("hall", 1)
    assert [scan["scan_id"] for scan in shown["scans"]] == ids[:100]
    assert (shown["scan_count"], version["scans"]) == (130, shown["scans"])
    assert [scan["scan_id"] for scan in client.map_scans("hall")] == ids
    assert client.version_scans("hall", 1) == client.map_scans("hall")


async def anchored(service: Any) -> None:
    async with AsyncClient("http://localhost", transport=httpx.ASGITransport(service)) as client:
        await client.set_anchor(
            "hall", {"longitude": 13.4, "latitude": 52.5, "height": 76.0, "heading": 90.0}
        )


def test_the_async_client_sets_an_anchor_and_not_only_says_so(tmp_path: Path) -> None:
    with running(settings_in(tmp_path), RememberingQueue()) as service:
        add_map(catalog_of(service), "hall")
        anyio.run(anchored, service.app)
        anchor = catalog_of(service).maps.summary("hall").anchor
    assert anchor is not None
    assert anchor.longitude == 13.4
