"""/webhooks: made, listed, changed and deleted; their secrets are shown once, and a key's maps are its own."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.following.webhooks import MOST
from service.settings import Settings
from tests.support.live import Live, live
from tests.support.processes import until
from tests.support.receivers import Receiver
from tests.support.samples import NOON, RememberingQueue, add_map, add_survey, catalog_of, running, tile

HOOK = "https://example.org/hook"


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as listening:
        yield listening


@pytest.fixture
def service(settings: Settings) -> Iterator[Live]:
    with live(settings.model_copy(update={"webhook_allowed_networks": "127.0.0.0/8"})) as served:
        yield served


def made(client: TestClient, **fields: Any) -> dict[str, Any]:
    answer = client.post("/webhooks", json={"url": HOOK, **fields})
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    document: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/webhooks/{document['webhook_id']}"
    return document


def test_each_change_reaches_the_receiver_once_signed_and_in_order(service: Live, receiver: Receiver) -> None:
    """From the request that makes the webhook to the receiver, through the service as it runs."""
    add_map(service.services.catalog)
    wanted = {"url": receiver.url, "types": ["change.told", "change.withdrawn"], "map": "lobby"}
    webhook = service.http.post("/webhooks", json=wanted).json()
    surveys = [
        add_survey(
            service.services.catalog, [tile(0, 0), tile(day, 1)], captured_at=NOON + timedelta(days=day)
        )[0]
        for day in (5, 4)
    ]
    assert service.http.delete(f"/surveys/{surveys[1]}").status_code == 204
    until(lambda: len(receiver.received) >= 4)
    events = [one.verified(webhook["secret"]) for one in receiver.received]
    assert [event["type"] for event in events] == ["change.told"] * 3 + ["change.withdrawn"]
    assert len({event["id"] for event in events}) == 4
    told = service.http.get("/events", params={"after": "0", "map": "lobby"}).json()["events"]
    assert [one for one in told if one["type"] in wanted["types"]] == events  # on every way the same


def test_a_ping_and_its_delivery(service: Live, receiver: Receiver) -> None:
    webhook = service.http.post("/webhooks", json={"url": receiver.url}).json()
    here = f"/webhooks/{webhook['webhook_id']}"
    pinged = service.http.post(f"{here}/ping")
    assert (pinged.status_code, pinged.json()["status"]) == (202, "pending")

    def listed() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = service.http.get(f"{here}/deliveries").json()["deliveries"]
        return found

    until(lambda: listed()[0]["status"] == "delivered")
    (delivery,) = listed()
    assert receiver.received[0].verified(webhook["secret"])["type"] == "webhook.ping"
    assert delivery["event_id"] == receiver.ids()[0]
    again = service.http.post(f"{here}/deliveries/{delivery['delivery_id']}/repeat")
    assert (again.status_code, again.json()["kind"]) == (202, "ping")
    until(lambda: len(receiver.received) == 2)
    assert receiver.ids()[0] == receiver.ids()[1]


def test_a_secret_is_shown_once(client: TestClient) -> None:
    webhook = made(client)
    here = f"/webhooks/{webhook['webhook_id']}"
    rotated = client.post(f"{here}/rotate")
    secrets = [webhook["secret"], rotated.json()["secret"]]
    assert len(set(secrets)) == 2
    assert all(secret.startswith("whsec_") for secret in secrets)
    assert rotated.headers["cache-control"] == "no-store"
    for path in ("/webhooks", here, f"{here}/deliveries"):
        text = client.get(path).text
        assert not any(secret in text for secret in secrets)
        assert "secret" not in text
    assert client.get(here).json()["previous_until"] is not None


def test_a_webhook_is_changed_and_switched_off_and_on(client: TestClient) -> None:
    here = f"/webhooks/{made(client, types=['change.told'])['webhook_id']}"
    assert client.patch(here, json={"types": ["survey.ready"]}).json()["types"] == ["survey.ready"]
    assert client.patch(here, json={"types": []}).json()["types"] is None
    assert client.patch(here, json={"url": "https://example.net/"}).json()["url"] == "https://example.net/"
    off = client.patch(here, json={"status": "disabled"}).json()
    assert (off["status"], off["reason"]) == ("disabled", "it was switched off")
    on = client.patch(here, json={"status": "active"}).json()
    assert (on["status"], on["reason"]) == ("active", None)
    assert client.patch(here, json={"url": "https://10.0.0.1/"}).status_code == 422
    assert client.delete(here).status_code == 204
    assert client.get(here).status_code == 404


def test_webhooks_are_listed_page_by_page(client: TestClient) -> None:
    ids = [made(client)["webhook_id"] for _ in range(3)]
    first = client.get("/webhooks", params={"limit": 2}).json()
    following = next(link["href"] for link in first["links"] if link["rel"] == "next")
    second = client.get(following).json()
    assert [one["webhook_id"] for one in first["webhooks"] + second["webhooks"]] == ids[::-1]


@pytest.mark.parametrize(
    "wrong",
    [
        {"url": "http://example.org/"},
        {"url": "https://127.0.0.1/"},
        {"url": "file:///etc/passwd"},
        {"types": ["survey.begun"]},
        {"types": []},
        {"map": "no such\x00"},
        {"secret": "whsec_mine"},
    ],
)
def test_what_makes_no_webhook_is_refused(client: TestClient, wrong: dict[str, Any]) -> None:
    answer = client.post("/webhooks", json={"url": HOOK, **wrong})
    assert answer.status_code == 422
    assert client.get("/webhooks").json()["webhooks"] == []


def test_there_are_only_so_many(client: TestClient, catalog: Catalog) -> None:
    for _ in range(MOST):
        catalog.webhooks.add(HOOK)
    assert client.post("/webhooks", json={"url": HOOK}).status_code == 409


def test_a_key_that_is_bound_to_a_map_has_the_webhooks_of_that_map(
    settings: Settings, queue: RememberingQueue
) -> None:
    with running(settings.model_copy(update={"auth": "required"}), queue) as client:
        catalog = catalog_of(client)
        add_map(catalog)
        add_map(catalog, "hall")
        _, bound = catalog.keys.add("hall", scopes=["maps:write"], maps=["hall"])
        _, reader = catalog.keys.add("reader", scopes=["changes:read"])
        of_all, _ = catalog.webhooks.add(HOOK)
        of_lobby, _ = catalog.webhooks.add(HOOK, map_id="lobby")
        client.headers["Authorization"] = f"Bearer {bound}"
        assert client.post("/webhooks", json={"url": HOOK}).status_code == 403
        assert client.post("/webhooks", json={"url": HOOK, "map": "lobby"}).status_code == 403
        own = made(client, map="hall")
        assert [one["webhook_id"] for one in client.get("/webhooks").json()["webhooks"]] == [
            own["webhook_id"]
        ]
        for webhook in (of_all, of_lobby):
            here = f"/webhooks/{webhook.webhook_id}"
            assert client.get(here).status_code == 403
            assert client.post(f"{here}/rotate").status_code == 403
            assert client.delete(here).status_code == 403
        assert client.get(f"/webhooks/{own['webhook_id']}").status_code == 200
        client.headers["Authorization"] = f"Bearer {reader}"
        assert client.get("/webhooks").status_code == 403
