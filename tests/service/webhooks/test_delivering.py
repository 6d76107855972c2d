"""Delivering: at least once, in order, under the event's id, by one process at a time, and with an end."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import update
from standardwebhooks import Webhook, WebhookVerificationError

from service.catalog import tallies
from service.catalog.catalog import Catalog, open_catalog
from service.catalog.following import deliveries as delivering
from service.catalog.following.publication import tell
from service.catalog.records import DeliveryRecord, EventType
from service.catalog.sql.tables import Webhook as WebhookRow
from service.catalog.sql.tables import WebhookDelivery, now
from service.errors import Gone, NotFound
from service.settings import Settings
from service.webhooks.addresses import networks
from service.webhooks.deliverer import Deliverer
from service.webhooks.sending import Sender
from tests.support.processes import until
from tests.support.receivers import Receiver
from tests.support.servers import postgresql

LOOPBACK = networks(["127.0.0.0/8"])
ROOT = Path(__file__).parents[3]


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver() as listening:
        yield listening


@pytest.fixture
def deliverer(catalog: Catalog) -> Deliverer:
    return Deliverer(catalog.deliveries, Sender(allowed=LOOPBACK))


def happen(catalog: Catalog, *subjects: str, type: EventType = "map.deleted", map_id: str = "lobby") -> None:
    """Have events published, one after the other."""
    for subject in subjects:
        with catalog.database.write() as session:
            tell(session, type, subject, map_id=map_id)


def hurry(catalog: Catalog) -> None:
    """Let the time pass until the next attempt, and until claims are over."""
    with catalog.database.write() as session:
        past = {"next_attempt": now() - timedelta(seconds=1), "claimed_until": None, "claim": None}
        session.execute(update(WebhookRow).values(**past))


def drain(catalog: Catalog, deliverer: Deliverer) -> None:
    """Deliver what is due now."""
    while due := catalog.deliveries.due():
        for webhook_id in due:
            deliverer.deliver(webhook_id)


def listed(catalog: Catalog, webhook_id: str) -> list[DeliveryRecord]:
    """Deliveries, oldest first."""
    return list(reversed(catalog.webhooks.deliveries(webhook_id).items))


def test_what_is_sent_is_signed_and_is_the_event(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, secret = catalog.webhooks.add(receiver.url)
    happen(catalog, "lobby")
    drain(catalog, deliverer)
    (request,) = receiver.received
    event = request.verified(secret)
    assert event["id"] == request.headers["webhook-id"] == catalog.events.after(0).items[0].event_id
    assert (event["specversion"], event["type"], event["source"]) == ("1.0", "map.deleted", "/maps/lobby")
    assert request.headers["Content-Type"].startswith("application/cloudevents+json")
    assert request.headers["Host"].startswith("127.0.0.1:")
    with pytest.raises(WebhookVerificationError):
        Webhook("whsec_b3RoZXI=").verify(request.body, request.headers)
    (delivery,) = listed(catalog, webhook.webhook_id)
    assert (delivery.status, delivery.answered, delivery.attempts) == ("delivered", 204, 1)
    assert catalog.webhooks.get(webhook.webhook_id).position == 1


def test_events_of_before_and_of_other_types_and_maps_are_not_sent(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    happen(catalog, "before")
    webhook, _ = catalog.webhooks.add(receiver.url, types=["map.deleted"], map_id="lobby")
    happen(catalog, "other type", type="job.ended")
    happen(catalog, "other map", map_id="hall")
    happen(catalog, "wanted")
    happen(catalog, "other map", map_id="hall")
    drain(catalog, deliverer)
    assert receiver.subjects() == ["wanted"]
    assert catalog.webhooks.get(webhook.webhook_id).position == catalog.events.last()


def test_the_order_is_kept_while_deliveries_fail(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, secret = catalog.webhooks.add(receiver.url)
    receiver.answers = [204, 500, 302, 503, 204]
    receiver.headers = {"Location": "/elsewhere"}
    happen(catalog, "first", "second", "third")
    for _ in range(4):
        drain(catalog, deliverer)
        hurry(catalog)
    assert receiver.subjects() == ["first", "second", "second", "second", "second", "third"]
    assert len(set(receiver.ids())) == 3  # each attempt at an event has its id
    for request in receiver.received:
        request.verified(secret)
    states = [(one.attempts, one.status, one.answered) for one in listed(catalog, webhook.webhook_id)]
    assert states == [(1, "delivered", 204), (4, "delivered", 204), (1, "delivered", 204)]


def test_the_next_attempt_waits_longer_each_time_and_a_webhook_that_never_answers_is_disabled(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url)
    receiver.answers = [500] * 8
    happen(catalog, "first", "second")
    waits = []
    for _ in range(7):
        drain(catalog, deliverer)
        assert catalog.deliveries.due() == ()  # it is not time yet
        waits.append((catalog.webhooks.get(webhook.webhook_id).next_attempt - now()).total_seconds())
        hurry(catalog)
    drain(catalog, deliverer)
    for wait, planned in zip(waits, delivering.SCHEDULE, strict=True):
        seconds = planned.total_seconds()
        assert seconds - 30 <= wait <= seconds * (1 + delivering.JITTER)
    disabled = catalog.webhooks.get(webhook.webhook_id)
    assert disabled.status == "disabled"
    assert disabled.reason == ("8 attempts at one event failed; the last one: the receiver answered 500")
    hurry(catalog)
    assert catalog.deliveries.due() == ()
    catalog.webhooks.change(webhook.webhook_id, active=True)
    drain(catalog, deliverer)
    assert receiver.subjects()[-2:] == ["first", "second"]  # nothing was lost


def test_a_receiver_that_is_gone_is_not_asked_again(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url)
    receiver.answers = [410]
    happen(catalog, "first", "second")
    drain(catalog, deliverer)
    assert receiver.subjects() == ["first"]
    record = catalog.webhooks.get(webhook.webhook_id)
    assert (record.status, record.reason) == ("disabled", "the receiver answered 410 Gone")


def test_nobody_who_listens_is_an_outcome_with_a_reason(catalog: Catalog, deliverer: Deliverer) -> None:
    with Receiver() as gone:
        url = gone.url
    webhook, _ = catalog.webhooks.add(url)
    happen(catalog, "first")
    drain(catalog, deliverer)
    (delivery,) = listed(catalog, webhook.webhook_id)
    assert (delivery.status, delivery.answered) == ("pending", None)
    assert delivery.error == "no connection: Connection refused"


def test_a_process_that_is_killed_before_it_records_leaves_the_event_to_another(
    settings: Settings, catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url)
    happen(catalog, "first", "second")
    script = (
        "import os, signal, sys\n"
        "from service.catalog.following.deliveries import Deliveries\n"
        "from service.catalog.sql.database import Database\n"
        "from service.webhooks.addresses import networks\n"
        "from service.webhooks.deliverer import Deliverer\n"
        "from service.webhooks.sending import Sender\n"
        "Deliveries.record = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"
        "sender = Sender(allowed=networks(['127.0.0.0/8']))\n"
        "Deliverer(Deliveries(Database(sys.argv[1])), sender).deliver(sys.argv[2])\n"
    )
    command = [sys.executable, "-c", script, settings.resolved_database_url(), webhook.webhook_id]
    killed = subprocess.run(command, cwd=ROOT, env=dict(os.environ), timeout=60, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert receiver.subjects() == ["first"]
    assert catalog.deliveries.due() == ()  # its claim holds
    assert catalog.deliveries.claim(webhook.webhook_id) is None
    hurry(catalog)
    drain(catalog, deliverer)
    assert receiver.subjects() == ["first", "first", "second"]
    assert receiver.ids()[0] == receiver.ids()[1]
    assert [one.status for one in listed(catalog, webhook.webhook_id)] == ["delivered", "delivered"]


def test_who_lost_its_claim_records_nothing(catalog: Catalog, receiver: Receiver) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url)
    happen(catalog, "first")
    slow = catalog.deliveries.claim(webhook.webhook_id)
    assert slow is not None
    assert catalog.deliveries.still_mine(slow)
    hurry(catalog)  # it was stopped for longer than its claim
    assert not catalog.deliveries.still_mine(slow)
    other = catalog.deliveries.claim(webhook.webhook_id)
    assert other is not None
    assert (other.delivery_id, other.event_id) == (slow.delivery_id, slow.event_id)
    assert not catalog.deliveries.record(slow, delivering.Outcome(error="too late"))
    assert catalog.deliveries.record(other, delivering.Outcome(answered=200))
    assert catalog.webhooks.get(webhook.webhook_id).position == 1


@pytest.mark.parametrize("on", ["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def test_several_hosts_send_each_event_once_in_order_and_one_at_a_time(
    settings: Settings, receiver: Receiver, on: str
) -> None:
    with postgresql() if on == "postgresql" else contextlib.nullcontext() as server:
        if server is not None:
            settings = settings.model_copy(update={"database_url": server.database()})
        catalogs = [open_catalog(settings) for _ in range(3)]
        first = catalogs[0]
        first.webhooks.add(receiver.url)
        subjects = [f"thing-{n}" for n in range(12)]
        sender = Sender(allowed=LOOPBACK)
        hosts = [Deliverer(catalog.deliveries, sender, every_s=0.02) for catalog in catalogs]
        for host in hosts:
            host.__enter__()
        happen(first, *subjects)
        until(lambda: len(receiver.received) >= 12)
        until(lambda: first.deliveries.due() == ())
        for host in hosts:
            host.__exit__()
        assert receiver.subjects() == subjects
        assert receiver.most_at_once == 1
        for catalog in catalogs:
            catalog.close()


def test_one_receiver_that_is_slow_holds_up_no_other(catalog: Catalog, receiver: Receiver) -> None:
    release = threading.Event()
    with Receiver(before_answer=lambda: release.wait(20)) as slow:
        catalog.webhooks.add(slow.url)
        catalog.webhooks.add(receiver.url)
        with Deliverer(catalog.deliveries, Sender(allowed=LOOPBACK), every_s=0.02):
            happen(catalog, "first", "second")
            until(lambda: receiver.subjects() == ["first", "second"])
            assert slow.received == []
            release.set()
            until(lambda: slow.subjects() == ["first", "second"])


def test_for_a_day_after_a_rotation_both_secrets_verify(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, before = catalog.webhooks.add(receiver.url)
    _, after = catalog.webhooks.rotate(webhook.webhook_id)
    happen(catalog, "first")
    drain(catalog, deliverer)
    for secret in (before, after):
        receiver.received[0].verified(secret)
    with catalog.database.write() as session:
        session.execute(update(WebhookRow).values(previous_until=now() - timedelta(seconds=1)))
    happen(catalog, "second")
    drain(catalog, deliverer)
    receiver.received[1].verified(after)
    with pytest.raises(WebhookVerificationError):
        receiver.received[1].verified(before)


def test_a_ping_is_sent_once_also_to_a_webhook_that_is_disabled(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, secret = catalog.webhooks.add(receiver.url)
    catalog.webhooks.change(webhook.webhook_id, active=False)
    receiver.answers = [500, 204]
    for _ in range(2):
        catalog.webhooks.ping(webhook.webhook_id)
        drain(catalog, deliverer)
        hurry(catalog)
    first, second = receiver.received
    assert first.verified(secret)["type"] == second.verified(secret)["type"] == "webhook.ping"
    assert [one.status for one in listed(catalog, webhook.webhook_id)] == ["failed", "delivered"]


def test_a_repetition_has_the_id_of_its_event_and_holds_up_nothing(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url)
    happen(catalog, "first", "second")
    drain(catalog, deliverer)
    first = listed(catalog, webhook.webhook_id)[0]
    catalog.webhooks.repeat(webhook.webhook_id, first.delivery_id)
    happen(catalog, "third")
    drain(catalog, deliverer)
    assert receiver.subjects() == ["first", "second", "first", "third"]
    assert receiver.ids()[2] == receiver.ids()[0]
    catalog.events.sweep(now() + timedelta(seconds=1))
    with pytest.raises(Gone):
        catalog.webhooks.repeat(webhook.webhook_id, first.delivery_id)
    with pytest.raises(NotFound):
        catalog.webhooks.repeat(webhook.webhook_id, "delivery-none")


def test_what_was_swept_before_it_could_be_sent_is_told(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url)
    catalog.webhooks.change(webhook.webhook_id, active=False)
    happen(catalog, "first", "second")
    catalog.events.sweep(now() + timedelta(seconds=1))
    happen(catalog, "third")
    catalog.webhooks.change(webhook.webhook_id, active=True)
    drain(catalog, deliverer)
    assert receiver.subjects() == ["third"]
    assert (
        catalog.webhooks.get(webhook.webhook_id).reason
        == "events up to 2 were swept before they could be sent"
    )


def test_old_deliveries_are_swept_and_those_that_wait_are_not(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver
) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url)
    receiver.answers = [204, 500]
    happen(catalog, "first", "second")
    drain(catalog, deliverer)
    with catalog.database.write() as session:
        session.execute(update(WebhookDelivery).values(updated=now() - timedelta(days=40)))
    catalog.webhooks.sweep(now() - timedelta(days=30))
    assert [one.status for one in listed(catalog, webhook.webhook_id)] == ["pending"]


def test_no_secret_reaches_the_log(
    catalog: Catalog, deliverer: Deliverer, receiver: Receiver, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    webhook, secret = catalog.webhooks.add(receiver.url)
    receiver.answers = [500, 410]
    happen(catalog, "first")
    drain(catalog, deliverer)
    task = catalog.deliveries.claim(webhook.webhook_id)
    hurry(catalog)
    task = catalog.deliveries.claim(webhook.webhook_id)
    assert secret not in repr(task)
    assert secret not in caplog.text
    assert "did not take" in caplog.text


def test_links_of_what_is_sent_bear_the_path_that_the_service_is_under(
    catalog: Catalog, receiver: Receiver
) -> None:
    behind_a_proxy = Deliverer(catalog.deliveries, Sender(allowed=LOOPBACK, root="/spicd"))
    webhook, _ = catalog.webhooks.add(receiver.url)
    catalog.webhooks.ping(webhook.webhook_id)
    happen(catalog, "lobby")
    drain(catalog, behind_a_proxy)
    ping, event = (one.event for one in receiver.received)
    assert ping["source"] == f"/spicd/webhooks/{webhook.webhook_id}"
    assert event["source"] == "/spicd/maps/lobby"


def test_attempts_are_counted_by_what_came_of_them_and_what_waits_is_told(
    catalog: Catalog, receiver: Receiver, deliverer: Deliverer
) -> None:
    webhook, _ = catalog.webhooks.add(receiver.url, types=["map.deleted"])
    catalog.webhooks.add(receiver.url, types=["scan.deleted"])
    happen(catalog, "one", "two")
    assert (catalog.deliveries.backlog().webhooks, catalog.deliveries.backlog().events) == ({"active": 2}, 2)
    receiver.answers = [500]
    drain(catalog, deliverer)
    hurry(catalog)
    drain(catalog, deliverer)
    assert catalog.deliveries.backlog().events == 0
    catalog.webhooks.change(webhook.webhook_id, url="http://127.0.0.1:1/")
    happen(catalog, "three")
    drain(catalog, deliverer)
    with catalog.database.read() as session:
        counted = {one.labels["outcome"]: one.count for one in tallies.read(session) if "webhook" in one.name}
    assert counted == {"refused": 1, "delivered": 2, "unanswered": 1}
