"""Deliveries to webhooks: which is next, who makes it, and what came of it.

A process claims a webhook, makes one attempt, and records it. A claim ends by itself, so that a process which was
killed holds up nothing for long; what it may have sent and not recorded is sent again, under the same id. Events go one
after the other: the next one waits until the one before it has arrived. Tests and repetitions, which somebody asked
for, are sent once and hold up nothing.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, cast

from sqlalchemy import ColumnElement, CursorResult, Select, exists, func, or_, select, update
from sqlalchemy.orm import Session

from service.catalog import tallies
from service.catalog.following.events import EventFilter, extent
from service.catalog.records import EventRecord, EventType
from service.catalog.sql.database import Database
from service.catalog.sql.tables import Event, Webhook, WebhookDelivery, new_id, now

#: Before each further attempt at an event (Standard Webhooks 1.0.0, "Deliverability and reliability"), 27.6 hours.
SCHEDULE = (
    timedelta(seconds=5),
    timedelta(minutes=5),
    timedelta(minutes=30),
    timedelta(hours=2),
    timedelta(hours=5),
    timedelta(hours=10),
    timedelta(hours=10),
)
JITTER = (
    0.2  #: share by which a wait is longer at most: receivers that come back are not asked by all at once
)
CLAIM = timedelta(seconds=60)  #: longer than any attempt
COUNTED = 10_000  #: events that wait for a webhook: counting more takes long, and says no more


@dataclass(frozen=True, kw_only=True, slots=True)
class Task:
    """One attempt to make; the claim is its own."""

    webhook_id: str
    delivery_id: str
    kind: str  #: `event`, or `ping` and `repeat`, which somebody asked for
    event: EventRecord | None  #: None: a ping
    event_id: str
    url: str
    secrets: tuple[str, ...] = field(repr=False)  #: that sign: the present one, and for a day the one before
    claim: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What came of an attempt."""

    answered: int | None = None  #: HTTP status; None: there was no answer
    error: str | None = None  #: why it failed

    @property
    def delivered(self) -> bool:
        """Whether the receiver took it."""
        return self.answered is not None and 200 <= self.answered < 300


@dataclass(frozen=True, kw_only=True, slots=True)
class Backlog:
    """What webhooks there are, and what waits for them."""

    webhooks: dict[str, int]  #: by status
    events: int  #: that active ones have still to get, COUNTED of each at most


class Deliveries:
    """The deliveries that are to be made."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def due(self) -> tuple[str, ...]:
        """Return the webhooks that have something to get now and that nobody sends to.

        One that waits for nothing of what was published has its position moved on.
        """
        instant = now()
        asked = exists().where(
            WebhookDelivery.webhook_id == Webhook.webhook_id,
            WebhookDelivery.status == "pending",
            WebhookDelivery.kind != "event",
        )
        with self._database.snapshot() as session:
            last = extent(session)[1]
            behind = (Webhook.status == "active", Webhook.next_attempt <= instant, Webhook.position < last)
            free = _free(instant)
            rows = session.scalars(select(Webhook).where(free, *behind)).all()
            waiting = {row.webhook_id: row.position for row in rows}
            idle = [row.webhook_id for row in rows if session.scalar(_next(row).limit(1)) is None]
            found = list(session.scalars(select(Webhook.webhook_id).where(free, asked)))
        for webhook_id in idle:
            self._move_on(webhook_id, waiting[webhook_id], last)
        return tuple({*found, *(waiting.keys() - set(idle))})

    def backlog(self) -> Backlog:
        """Count the webhooks, and what waits for those that are active."""
        with self._database.snapshot() as session:
            by_status = select(Webhook.status, func.count()).group_by(Webhook.status)
            webhooks = dict(session.execute(by_status).all())
            last = extent(session)[1]
            behind = select(Webhook).where(Webhook.status == "active", Webhook.position < last)
            events = sum(_count(session, row) for row in session.scalars(behind).all())
        return Backlog(webhooks=webhooks, events=events)

    def claim(self, webhook_id: str) -> Task | None:
        """Take the next attempt at a webhook; None where there is none, or another has claimed it."""
        instant, claim = now(), new_id("claim")
        with self._database.write() as session:
            mine = {"claim": claim, "claimed_until": instant + CLAIM}
            which = (Webhook.webhook_id == webhook_id, _free(instant))
            if not _done(session.execute(update(Webhook).where(*which).values(**mine))):
                return None
            row = session.get_one(Webhook, webhook_id, populate_existing=True)
            task = _asked_for(session, row, claim) or _following(session, row, claim, instant)
            if task is None:
                row.claim = row.claimed_until = None
            return task

    def still_mine(self, task: Task) -> bool:
        """Tell whether a claim holds, with time for an attempt; who was stopped for long asks before it sends."""
        left = now() + CLAIM / 2
        with self._database.read() as session:
            until = session.scalar(
                select(Webhook.claimed_until).where(
                    Webhook.webhook_id == task.webhook_id, Webhook.claim == task.claim
                )
            )
        return until is not None and until > left

    def record(self, task: Task, outcome: Outcome) -> bool:
        """Record an attempt and let the webhook go; False where the claim was over, and another makes it again."""
        instant = now()
        with self._database.write() as session:
            which = (Webhook.webhook_id == task.webhook_id, Webhook.claim == task.claim)
            row = session.scalar(select(Webhook).where(*which).with_for_update())
            delivery = session.get(WebhookDelivery, task.delivery_id)
            if row is None or delivery is None:
                return False
            delivery.attempts += 1
            delivery.answered, delivery.error, delivery.updated = outcome.answered, outcome.error, instant
            row.claim = row.claimed_until = None
            tallies.tally_delivery(session, outcome.answered, delivered=outcome.delivered)
            if outcome.delivered:
                delivery.status = "delivered"
            elif task.kind != "event":
                delivery.status = "failed"
            if task.kind == "event" and task.event is not None:
                _take_note(row, delivery, task.event.sequence, outcome, instant)
            if outcome.answered == 410:
                _disable(row, delivery, "the receiver answered 410 Gone", instant)
            return True

    def _move_on(self, webhook_id: str, position: int, last: int) -> None:
        """Pass over events that a webhook does not want."""
        which = (Webhook.webhook_id == webhook_id, Webhook.position == position, _free(now()))
        with self._database.write() as session:
            session.execute(update(Webhook).where(*which).values(position=last))


def _free(instant: datetime) -> ColumnElement[bool]:
    return or_(Webhook.claimed_until.is_(None), Webhook.claimed_until < instant)


def _next(row: Webhook) -> Select[Event]:
    """Return a query for the events that a webhook still has to get, in order."""
    wanted = EventFilter(
        types=None if row.types is None else cast("list[EventType]", row.types),
        maps=None if row.map_id is None else (row.map_id,),
    )
    query = select(Event).where(Event.sequence > row.position, *wanted.conditions()).order_by(Event.sequence)
    # one that named no types is not told with each visit that all is as it was
    return query if row.types is not None else query.where(Event.data["only_times"].as_boolean().is_not(True))


def _count(session: Session, row: Webhook) -> int:
    waiting = _next(row).with_only_columns(Event.sequence).limit(COUNTED).subquery()
    return session.scalar(select(func.count()).select_from(waiting)) or 0


def _asked_for(session: Session, row: Webhook, claim: str) -> Task | None:
    """Return the oldest test or repetition that waits."""
    query = select(WebhookDelivery).where(
        WebhookDelivery.webhook_id == row.webhook_id,
        WebhookDelivery.status == "pending",
        WebhookDelivery.kind != "event",
    )
    delivery = session.scalar(query.order_by(WebhookDelivery.created, WebhookDelivery.delivery_id).limit(1))
    if delivery is None:
        return None
    event = session.scalar(select(Event).where(Event.event_id == delivery.event_id))
    if event is None and delivery.kind == "repeat":
        delivery.status, delivery.error = "failed", "the event is not kept any more"
        return None
    return _task(row, delivery, event, claim)


def _following(session: Session, row: Webhook, claim: str, instant: datetime) -> Task | None:
    """Return the next event that a webhook has to get, if it is time."""
    if row.status != "active" or row.next_attempt > instant:
        return None
    swept = extent(session)[0]
    if row.position < swept:
        row.reason = f"events up to {swept} were swept before they could be sent"
        row.position, row.attempts = swept, 0
    event = session.scalar(_next(row).limit(1))
    if event is None:
        return None
    begun = select(WebhookDelivery).where(
        WebhookDelivery.webhook_id == row.webhook_id,
        WebhookDelivery.event_id == event.event_id,
        WebhookDelivery.kind == "event",
        WebhookDelivery.status == "pending",
    )
    delivery = session.scalar(begun.limit(1))
    if delivery is None:
        delivery = WebhookDelivery(
            delivery_id=new_id("delivery"),
            webhook_id=row.webhook_id,
            kind="event",
            event_id=event.event_id,
            type=event.type,
            status="pending",
            attempts=0,
            created=instant,
            updated=instant,
        )
        session.add(delivery)
    return _task(row, delivery, event, claim)


def _task(row: Webhook, delivery: WebhookDelivery, event: Event | None, claim: str) -> Task:
    secrets = [row.secret]
    if row.previous_secret is not None and row.previous_until is not None and row.previous_until > now():
        secrets.append(row.previous_secret)
    return Task(
        webhook_id=row.webhook_id,
        delivery_id=delivery.delivery_id,
        kind=delivery.kind,
        event=None if event is None else EventRecord.of_row(event),
        event_id=delivery.event_id,
        url=row.url,
        secrets=tuple(secrets),
        claim=claim,
    )


def _take_note(
    row: Webhook, delivery: WebhookDelivery, sequence: int, outcome: Outcome, instant: datetime
) -> None:
    """Go on behind an event that arrived; have one that did not wait, or give the webhook up."""
    if outcome.delivered:
        row.position, row.attempts, row.next_attempt = max(row.position, sequence), 0, instant
        return
    row.attempts += 1
    if row.attempts <= len(SCHEDULE):
        row.next_attempt = instant + wait_before(row.attempts)
    else:
        last = outcome.error or f"HTTP {outcome.answered}"
        _disable(row, delivery, f"{row.attempts} attempts at one event failed; the last one: {last}", instant)


def wait_before(attempts: int, *, schedule: Sequence[timedelta] | None = None) -> timedelta:
    """Return how long to wait after so many attempts that failed, with jitter."""
    waits = SCHEDULE if schedule is None else schedule
    return waits[attempts - 1] * (1 + random.uniform(0, JITTER))  # noqa: S311  # nosec B311 - no secret


def _disable(row: Webhook, delivery: WebhookDelivery, reason: str, instant: datetime) -> None:
    row.status, row.reason, row.updated = "disabled", reason, instant
    delivery.status = "failed"


def _done(result: Any) -> bool:
    return cast("CursorResult[Any]", result).rowcount == 1
