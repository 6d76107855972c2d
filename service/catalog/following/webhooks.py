"""Webhooks: addresses that events are sent to, with the secrets that sign what is sent.

A secret has to be kept as it is, for a signature needs it; it is in no record, no list and no line of a log.
"""

from __future__ import annotations

import base64
import secrets
from collections.abc import Collection, Sequence
from datetime import datetime, timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.catalog.following.events import extent, require_known
from service.catalog.idempotency import ANY_TIMES, Once
from service.catalog.records import DeliveryRecord, EventType, Page, Position, WebhookRecord
from service.catalog.sql.database import Database
from service.catalog.sql.tables import Event, Webhook, WebhookDelivery, new_id, now
from service.errors import Conflict, Gone, NotFound

PREFIX = "whsec_"  #: Standard Webhooks 1.0.0, "Signature scheme"
MOST = 100  #: webhooks of one service
ROTATED = timedelta(days=1)  #: for which the earlier secret signs as well
PING = "webhook.ping"
_BYTES = 32


class Webhooks:
    """The webhooks of the catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(
        self,
        url: str,
        *,
        types: Sequence[EventType] | None = None,
        map_id: str | None = None,
        once: Once = ANY_TIMES,
    ) -> tuple[WebhookRecord, str]:
        """Record a webhook for what is published from now on; returns it with its secret, which is not shown again.

        Raises NotFound (the map), Conflict where there are as many as may be, and what `once` does.
        """
        secret, instant = new_secret(), now()
        row = Webhook(
            webhook_id=new_id("webhook"),
            url=url,
            types=None if types is None else list(types),
            map_id=map_id,
            secret=secret,
            status="active",
            attempts=0,
            next_attempt=instant,
            created=instant,
            updated=instant,
        )
        with self._database.write() as session:
            once.claim(session)
            if map_id is not None:
                require_known(session, map_id)
            if len(session.scalars(select(Webhook.webhook_id)).all()) >= MOST:
                raise Conflict(f"there are {MOST} webhooks, as many as may be; delete one that is not needed")
            row.position = extent(session)[1]
            session.add(row)
            session.flush()
            made = WebhookRecord.of_row(row), secret
            once.keep(session, *made)
            return made

    def get(self, webhook_id: str) -> WebhookRecord:
        """Return one webhook. Raises NotFound."""
        with self._database.read() as session:
            return WebhookRecord.of_row(_row(session, webhook_id))

    def page(
        self, *, maps: Collection[str] | None = None, after: Position | None = None, limit: int = 100
    ) -> Page[WebhookRecord]:
        """Return webhooks, newest first; of these maps alone where that is given."""
        query = select(Webhook) if maps is None else select(Webhook).where(Webhook.map_id.in_(maps))
        created, key = Webhook.created, Webhook.webhook_id
        return self._database.page(query, created, key, WebhookRecord.of_row, after=after, limit=limit)

    def change(
        self,
        webhook_id: str,
        *,
        url: str | None = None,
        types: Sequence[EventType] | None = None,
        active: bool | None = None,
    ) -> WebhookRecord:
        """Change what is not None. One that becomes active goes on behind the last event that it got. Raises NotFound."""
        instant = now()
        with self._database.write() as session:
            row = _row(session, webhook_id, lock=True)
            row.url = url or row.url
            row.types = row.types if types is None else list(types) or None
            if active is False:
                row.status, row.reason = "disabled", "it was switched off"
            elif active or (active is None and url is not None and row.status == "active"):
                row.status, row.reason, row.attempts, row.next_attempt = "active", None, 0, instant
            row.updated = instant
            session.flush()
            return WebhookRecord.of_row(row)

    def rotate(self, webhook_id: str, *, once: Once = ANY_TIMES) -> tuple[WebhookRecord, str]:
        """Give it another secret; the one before signs as well for a day. Raises NotFound, and what `once` does."""
        secret, instant = new_secret(), now()
        with self._database.write() as session:
            once.claim(session)
            row = _row(session, webhook_id, lock=True)
            row.previous_secret, row.previous_until = row.secret, instant + ROTATED
            row.secret, row.updated = secret, instant
            session.flush()
            made = WebhookRecord.of_row(row), secret
            once.keep(session, *made)
            return made

    def delete(self, webhook_id: str) -> None:
        """Delete a webhook with the list of its deliveries. Raises NotFound."""
        with self._database.write() as session:
            session.delete(_row(session, webhook_id, lock=True))

    def deliveries(
        self, webhook_id: str, *, after: Position | None = None, limit: int = 100
    ) -> Page[DeliveryRecord]:
        """Return what was sent to a webhook, or is to be, newest first. Raises NotFound."""
        with self._database.read() as session:
            _row(session, webhook_id)
        query = select(WebhookDelivery).where(WebhookDelivery.webhook_id == webhook_id)
        created, key = WebhookDelivery.created, WebhookDelivery.delivery_id
        return self._database.page(query, created, key, DeliveryRecord.of_row, after=after, limit=limit)

    def ping(self, webhook_id: str) -> DeliveryRecord:
        """Have a test sent, once, also to one that is disabled. Raises NotFound."""
        with self._database.write() as session:
            _row(session, webhook_id)
            return _deliver(session, webhook_id, kind="ping", event_id=new_id("event"), type=PING)

    def repeat(self, webhook_id: str, delivery_id: str) -> DeliveryRecord:
        """Have the event of a delivery sent again, once, under the same id. Raises NotFound, and Gone for an old one."""
        with self._database.write() as session:
            _row(session, webhook_id)
            sent = session.get(WebhookDelivery, delivery_id)
            if sent is None or sent.webhook_id != webhook_id:
                raise NotFound(f"no delivery {delivery_id!r} to webhook {webhook_id!r}")
            kept = session.scalar(select(Event.sequence).where(Event.event_id == sent.event_id))
            if kept is None and sent.type != PING:
                raise Gone(f"the event of delivery {delivery_id!r} is not kept any more")
            kind = "ping" if sent.type == PING else "repeat"
            return _deliver(session, webhook_id, kind=kind, event_id=sent.event_id, type=sent.type)

    def sweep(self, before: datetime) -> None:
        """Remove deliveries that ended before an instant from the list."""
        old = WebhookDelivery.updated < before
        with self._database.write() as session:
            query = session.query(WebhookDelivery).where(old, WebhookDelivery.status != "pending")
            query.delete(synchronize_session=False)


def new_secret() -> str:
    """Return a fresh secret as Standard Webhooks writes it."""
    return PREFIX + base64.b64encode(secrets.token_bytes(_BYTES)).decode()


def _deliver(session: Session, webhook_id: str, *, kind: str, event_id: str, type: str) -> DeliveryRecord:
    instant = now()
    row = WebhookDelivery(
        delivery_id=new_id("delivery"),
        webhook_id=webhook_id,
        kind=kind,
        event_id=event_id,
        type=type,
        status="pending",
        attempts=0,
        created=instant,
        updated=instant,
    )
    session.add(row)
    session.flush()
    return DeliveryRecord.of_row(row)


def _row(session: Session, webhook_id: str, *, lock: bool = False) -> Webhook:
    row = session.get(Webhook, webhook_id, with_for_update=lock)
    if row is None:
        raise NotFound(f"no webhook {webhook_id!r}; GET /webhooks lists those there are")
    return row
