"""/events: a stream and a list, behind a real server; nothing lost, nothing doubled, and an end with the service."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from service.api.following import events
from service.api.following.events import EventList
from service.catalog.catalog import Catalog
from service.catalog.sql.tables import now
from service.errors import DatabaseUnavailable
from service.settings import Settings
from service.up import launcher
from service.up.connections import Limits
from tests.support.live import Live, live
from tests.support.processes import until
from tests.support.samples import NOON, add_map, add_scan, add_survey, catalog_of, running, tile
from tests.support.servers import free_port

SSE = {"Accept": "text/event-stream"}

Told = dict[str, Any]


@pytest.fixture
def service(settings: Settings) -> Iterator[Live]:
    with live(settings) as served:
        yield served


def stream(lines: Iterator[str]) -> Iterator[tuple[str | None, Told | None]]:
    """Id and data of each entry of a stream, those without data among them (HTML Living Standard, Section 9.2.6)."""
    fields: dict[str, str] = {}
    for line in lines:
        if line:
            name, _, value = line.partition(": ")
            fields[name] = value
        elif fields:
            yield fields.get("id"), json.loads(fields["data"]) if "data" in fields else None
            fields = {}


def read(served: Live, count: int, headers: dict[str, str] | None = None, **asked: Any) -> list[Told]:
    """So many events of a stream, which is then left."""
    found: list[Told] = []
    with served.http.stream("GET", "/events", params=asked, headers={**SSE, **(headers or {})}) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        for _, told in stream(answer.iter_lines()):
            found += [told] if told is not None else []
            if len(found) == count:
                break
    return found


def test_a_stream_tells_what_happens_while_it_is_open(service: Live) -> None:
    catalog = service.services.catalog
    add_map(catalog)
    with service.http.stream("GET", "/events", headers=SSE) as answer:
        entries = stream(answer.iter_lines())
        begin, nothing = next(entries)
        assert (begin, nothing) == (str(catalog.events.last()), None)
        add_survey(catalog, [tile(0, 0)], captured_at=NOON)
        told = [next(entries) for _ in range(4)]
    types = [event["type"] for _, event in told if event is not None]
    assert types == ["scan.uploaded", "job.ended", "survey.ready", "change.told"]
    assert [int(number or 0) for number, _ in told] == list(range(int(begin or 0) + 1, int(begin or 0) + 5))
    until(lambda: service.listeners() == 0, 20)


def test_the_links_of_an_event_lead_to_what_it_is_about(service: Live) -> None:
    catalog = service.services.catalog
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0), tile(1, 0)], captured_at=NOON)
    events = service.http.get("/events", params={"after": "0", "type": "change.told"}).json()["events"]
    assert len(events) == 2
    for event in events:
        links = {link["rel"]: link["href"] for link in event["data"]["links"]}
        (feature,) = service.http.get(links["related"]).json()["features"]
        assert feature["properties"]["change_id"] == event["subject"] == event["data"]["change_id"]
        assert links["survey"] == f"/surveys/{survey_id}"
    for event in service.http.get("/events", params={"after": "0"}).json()["events"]:
        for link in event["data"]["links"]:
            assert service.http.get(link["href"]).status_code == 200, link


def test_who_comes_back_with_the_last_id_misses_and_repeats_nothing(service: Live) -> None:
    """The stream is cut again and again while surveys of a map end in another thread."""
    catalog = service.services.catalog
    add_map(catalog)
    begin = catalog.events.last()

    def visits() -> None:
        for day in range(8):
            add_survey(catalog, [tile(day, 0)], captured_at=NOON + timedelta(days=day))

    writer = threading.Thread(target=visits)
    writer.start()
    seen: list[Told] = []
    while len(seen) < 8 * 4:
        last = seen[-1]["sequence"] if seen else str(begin)
        seen += read(service, 3 if len(seen) < 27 else 8 * 4 - len(seen), {"Last-Event-ID": last})
    writer.join()
    assert [int(event["sequence"]) for event in seen] == list(range(begin + 1, begin + 33))
    assert len({event["id"] for event in seen}) == 32


def test_a_quiet_stream_gives_signs_of_life_and_moves_the_cursor(
    service: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "KEEP_ALIVE_S", 0.1)
    catalog = service.services.catalog
    asked = {"type": "map.deleted"}
    with service.http.stream("GET", "/events", params=asked, headers=SSE) as answer:
        entries = stream(answer.iter_lines())
        assert next(entries) == ("0", None)
        add_scan(catalog, "hall")
        numbers = {next(entries)[0] for _ in range(20)}
    assert "1" in numbers


def test_a_stream_ends_after_its_time_and_the_key_is_asked_for_again(
    service: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "LONGEST_S", 0.3)
    monkeypatch.setattr(events, "KEEP_ALIVE_S", 0.1)
    with service.http.stream("GET", "/events", headers=SSE) as answer:
        assert list(answer.iter_lines())  # it ends by itself, as an answer ends


def test_no_limit_on_connections_cuts_a_stream_that_is_quiet(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    brief = Limits(header_s=0.2, body_window_s=0.2, linger_s=0.2, write_s=0.2, close_s=0.2)
    monkeypatch.setattr(launcher, "limits_of", lambda _: brief)
    monkeypatch.setattr(events, "KEEP_ALIVE_S", 0.5)
    with live(settings) as served, served.http.stream("GET", "/events", headers=SSE) as answer:
        entries = stream(answer.iter_lines())
        assert [next(entries)[1] for _ in range(4)] == [None] * 4  # longer than any of the limits
        add_scan(served.services.catalog, "hall")
        assert next(told for _, told in entries if told is not None)["type"] == "scan.uploaded"


def test_the_service_ends_within_its_grace_while_others_listen(settings: Settings) -> None:
    clients: list[httpx.Client] = []
    ended: list[str] = []

    def listen(url: str, headers: dict[str, str], asked: dict[str, str]) -> None:
        client = httpx.Client(base_url=url, timeout=30)
        clients.append(client)
        with client.stream("GET", "/events", params=asked, headers=headers) as answer:
            for _ in answer.iter_lines():
                pass
        ended.append("whole")  # an answer that is cut raises

    with live(settings.model_copy(update={"shutdown_grace_s": 20})) as served:
        add_map(served.services.catalog)
        ways = [(SSE, {}), (SSE, {"map": "lobby"}), ({}, {"wait": "60"})]
        threads = [threading.Thread(target=listen, args=(served.url, *way)) for way in ways]
        for thread in threads:
            thread.start()
        until(lambda: served.listeners() == 3, 20)
    for thread in threads:
        thread.join(10)
    assert ended == ["whole"] * 3  # before the grace was over: it cuts what is left then
    for client in clients:
        client.close()


def test_as_many_listen_as_may(settings: Settings) -> None:
    with live(settings.model_copy(update={"max_listeners": 1})) as served:
        with served.http.stream("GET", "/events", headers=SSE):
            until(lambda: served.listeners() == 1, 20)
            refused = httpx.get(f"{served.url}/events", timeout=20)
            assert refused.status_code == 503
            assert refused.json()["type"] == "urn:spicd:problem:unavailable"
            assert "Retry-After" in refused.headers
        until(lambda: served.listeners() == 0, 20)
        assert served.http.get("/events").status_code == 200


def test_a_stream_outlasts_the_database_for_a_while(service: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    catalog = service.services.catalog
    log = service.services.listeners._events
    with service.http.stream("GET", "/events", headers=SSE) as answer:
        entries = stream(answer.iter_lines())
        next(entries)
        until(lambda: service.services.listeners._head is not None)  # till then the stream reads by itself
        with monkeypatch.context() as patch:
            looks: list[int] = []

            def away(*_: object, **__: object) -> None:
                looks.append(1)
                raise DatabaseUnavailable("it does not answer")

            patch.setattr(log, "after", away)
            add_scan(catalog, "hall")
            until(lambda: len(looks) >= 3)
        told = next(told for _, told in entries if told is not None)
    assert told["type"] == "scan.uploaded"


# lists


def test_a_list_waits_for_what_is_not_there_yet(service: Live) -> None:
    catalog = service.services.catalog
    first = service.http.get("/events").json()
    assert (first["events"], first["cursor"]) == ([], "0")
    timer = threading.Timer(0.3, add_scan, args=(catalog, "hall"))
    timer.start()
    answer = service.http.get("/events", params={"after": first["cursor"], "wait": "20"})
    EventList.model_validate(answer.json())
    assert [event["type"] for event in answer.json()["events"]] == ["scan.uploaded"]
    assert answer.headers["cache-control"] == "no-store"
    timer.join()


def test_lists_hold_every_event_once(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    for day in range(3):
        add_survey(catalog, [tile(day, 0)], captured_at=NOON + timedelta(days=day))
    url, seen = "/events?after=0&limit=4", []
    while True:
        document = client.get(url).json()
        if not document["events"]:
            break
        seen += [int(event["sequence"]) for event in document["events"]]
        url = next(link["href"] for link in document["links"] if link["rel"] == "next")
    assert seen == list(range(1, catalog.events.last() + 1))


@pytest.mark.parametrize("headers", [SSE, {}])
def test_a_map_that_is_not_there_is_not_listened_to_in_silence(
    client: TestClient, catalog: Catalog, headers: dict[str, str]
) -> None:
    add_map(catalog)
    answer = client.get("/events", params={"map": "loby"}, headers=headers)
    assert (answer.status_code, answer.json()["type"]) == (404, "urn:spicd:problem:not_found")
    refused = client.post("/webhooks", json={"url": "https://example.org/hook", "map": "loby"})
    assert (refused.status_code, client.get("/webhooks").json()["webhooks"]) == (404, [])


def test_a_map_that_was_deleted_can_be_asked_for_as_long_as_its_events_are_kept(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    catalog.maps.delete("lobby")
    events = client.get("/events", params={"map": "lobby", "after": "0"}).json()["events"]
    assert events[-1]["type"] == "map.deleted"
    asked = {"url": "https://example.org/hook", "map": "lobby"}
    assert client.post("/webhooks", json=asked).status_code == 201
    catalog.events.sweep(now() + timedelta(seconds=1))
    assert client.get("/events", params={"map": "lobby"}).status_code == 404


def test_filters_are_by_map_and_type(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_map(catalog, "hall")

    def types(**asked: Any) -> list[str]:
        answer = client.get("/events", params={"after": "0", **asked})
        assert answer.status_code == 200, answer.text
        return [event["type"] for event in answer.json()["events"]]

    assert types(map="hall") == ["job.ended", "version.ready"]
    assert types(type=["scan.uploaded", "version.ready"], map="hall") == ["version.ready"]
    assert types(type=["scan.uploaded", "version.ready"]) == ["scan.uploaded", "version.ready"] * 2


@pytest.mark.parametrize(
    "asked", [{"after": "x"}, {"type": "survey.begun"}, {"wait": "61"}, {"limit": "0"}, {"since": "1"}]
)
def test_a_value_that_does_not_match_is_named(client: TestClient, asked: dict[str, str]) -> None:
    answer = client.get("/events", params=asked)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["place"].startswith(f"query.{next(iter(asked))}")


def test_an_id_that_is_no_number_is_refused_before_a_stream_begins(client: TestClient) -> None:
    assert client.get("/events", headers={**SSE, "Last-Event-ID": "abc"}).status_code == 422


@pytest.mark.parametrize("headers", [SSE, {}])
def test_a_cursor_of_long_ago_is_gone(client: TestClient, catalog: Catalog, headers: dict[str, str]) -> None:
    add_scan(catalog, "first")
    add_scan(catalog, "second")
    add_scan(catalog, "third")
    catalog.events.sweep(now() + timedelta(seconds=1))
    answer = client.get("/events", params={"after": "1"}, headers=headers)
    assert answer.status_code == 410
    assert answer.json()["type"] == "urn:spicd:problem:gone"


def test_a_key_that_is_bound_to_a_map_sees_the_events_of_that_map(settings: Settings, queue: Any) -> None:
    with running(settings.model_copy(update={"auth": "required"}), queue) as client:
        catalog = catalog_of(client)
        add_map(catalog)
        add_map(catalog, "hall")
        _, bound = catalog.keys.add("dashboard", scopes=["changes:read"], maps=["hall"])
        _, writer = catalog.keys.add("robot", scopes=["scans:write"])
        headers = {"Authorization": f"Bearer {bound}"}
        answer = client.get("/events", params={"after": "0"}, headers=headers)
        assert {event["source"] for event in answer.json()["events"]} == {"/maps/hall"}
        assert client.get("/events", params={"map": "lobby"}, headers=headers).status_code == 403
        assert client.get("/events", headers={"Authorization": f"Bearer {writer}"}).status_code == 403
        assert client.get("/events").status_code == 401


# the page


def on_the_page() -> dict[str, Any]:
    """What the Python of docs/events.md defines."""
    page = (Path(__file__).parents[4] / "docs/events.md").read_text()
    names: dict[str, Any] = {}
    for code in re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        exec(code, names)
    return names


def test_the_loop_of_the_page_follows_changes_and_goes_on_where_it_was(service: Live, tmp_path: Path) -> None:
    catalog, follow = service.services.catalog, on_the_page()["follow"]
    add_map(catalog)
    kept = {"kept": tmp_path / "cursor", "pause_s": 0.05}
    seen = []
    for day in (5, 4):  # the earlier visit is uploaded later
        add_survey(catalog, [tile(0, 0), tile(day, 1)], captured_at=NOON + timedelta(days=day))
        changes = follow(service.url, "lobby", **kept)
        seen += [next(changes)["properties"]["tile_id"][5:8] for _ in range(2 if day == 5 else 1)]
        add_survey(catalog, [tile(9, day)], captured_at=NOON + timedelta(days=day, hours=1))
        seen.append(next(changes)["properties"]["tile_id"][5:8])  # which has the cursor of before written
    assert sorted(seen) == ["000", "004", "005", "009", "009"]


def test_the_receiver_of_the_page_takes_what_was_signed(settings: Settings) -> None:
    taken: list[Told] = []
    allowed = settings.model_copy(update={"webhook_allowed_networks": "127.0.0.0/8"})
    with live(allowed) as served:
        port = free_port()
        webhook = served.http.post("/webhooks", json={"url": f"http://127.0.0.1:{port}/"}).json()
        receiver = on_the_page()["receiver"](webhook["secret"], taken.append, port)
        threading.Thread(target=receiver.serve_forever, daemon=True).start()
        scan = add_scan(served.services.catalog, "hall")
        until(lambda: taken)
        refused = httpx.post(f"http://127.0.0.1:{port}/", content=b"{}", timeout=20)
        receiver.shutdown()
        receiver.server_close()
    assert (taken[0]["type"], taken[0]["subject"]) == ("scan.uploaded", scan.scan_id)
    assert refused.status_code == 401
