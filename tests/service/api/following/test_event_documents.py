"""The schemas of events: each sort has one, and every event that is told keeps to its own, no member more or less."""

from __future__ import annotations

from datetime import timedelta
from typing import Any, cast, get_args

from fastapi.testclient import TestClient
from pydantic_core import from_json

from service.api.following.event_documents import CloudEvent, WebhookEvent
from service.catalog.catalog import Catalog
from service.catalog.following.deliveries import Task
from service.catalog.following.webhooks import PING
from service.catalog.records import EventType, Problem
from service.webhooks.sending import body_of
from tests.support.samples import NOON, add_map, add_survey, place, thing, tile

TYPES = set(get_args(EventType))


def members_of(event: dict[str, Any]) -> dict[str, Any]:
    """The same event through its schema, which leaves out what it does not know."""
    return cast("dict[str, Any]", WebhookEvent.model_validate(event).model_dump(mode="json"))


def test_every_type_has_a_schema() -> None:
    mapping = CloudEvent.model_json_schema()["discriminator"]["mapping"]
    assert set(mapping) == TYPES
    assert set(WebhookEvent.model_json_schema()["discriminator"]["mapping"]) == {*TYPES, PING}


def test_what_is_told_keeps_to_its_schema(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    kept, _ = add_survey(catalog, [tile(0, 0)], captured_at=NOON, objects=[thing(1, now=place(1, 1))])
    later = NOON + timedelta(hours=1)
    again, _ = add_survey(catalog, [tile(0, 0)], captured_at=later, objects=[thing(1, now=place(1, 1))])
    assert client.delete(f"/surveys/{again}").status_code == 204
    gone, _ = add_survey(catalog, [tile(1, 0)], captured_at=NOON + timedelta(days=1), objects=[])
    assert client.delete(f"/surveys/{gone}").status_code == 204
    assert client.delete(f"/surveys/{kept}").status_code == 204
    _, failed = add_survey(catalog, ready=False)
    catalog.jobs.fail(failed, Problem(code="registration_failed", detail="no scan fits"))
    for scan in client.get("/scans").json()["scans"]:
        client.delete(f"/scans/{scan['scan_id']}")
    assert client.delete("/maps/lobby").status_code == 204
    events = client.get("/events", params={"after": "0", "limit": 1000}).json()["events"]
    for event in events:
        assert members_of(event) == event
    told = {event["type"] for event in events}
    assert told >= {
        "scan.uploaded",
        "job.ended",
        "version.ready",
        "survey.ready",
        "survey.failed",
        "survey.deleted",
        "change.told",
        "change.updated",
        "change.withdrawn",
        "object.told",
        "object.updated",
        "object.withdrawn",
        "map.deleted",
    }


def test_a_job_that_failed_is_told_with_the_problem_of_its_document(
    client: TestClient, catalog: Catalog
) -> None:
    job_id = add_map(catalog, ready=False)
    catalog.jobs.fail(job_id, Problem(code="map_failed", detail="the scans do not meet"))
    ended, version = client.get("/events", params={"after": "0"}).json()["events"][-2:]
    assert ended["data"]["problem"] == client.get(f"/jobs/{job_id}").json()["problem"]["type"]
    assert (version["type"], version["subject"]) == ("version.failed", "lobby/1")


def test_a_ping_keeps_to_its_schema() -> None:
    task = Task(
        webhook_id="webhook-1",
        delivery_id="delivery-1",
        kind="ping",
        event=None,
        event_id="event-1",
        url="https://example.org/",
        secrets=(),
        claim="claim-1",
    )
    event = from_json(body_of(task))
    assert event["type"] == PING
    assert members_of(event) == event
