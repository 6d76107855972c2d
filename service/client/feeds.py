"""What the service tells as it happens: pages of changes, events and webhooks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal, NotRequired, TypedDict, cast

from httpx_sse import ServerSentEvent

from service.client.documents import TileCollection, TileFeature
from service.client.errors import ClientError, Document

FROM_THE_START = "0"  #: the cursor before everything that was ever published


@dataclass(frozen=True, kw_only=True, slots=True)
class ChangesPage:
    """Changes that were published since the page before it."""

    features: list[
        TileFeature
    ]  #: each once as new, and again with the property `updated` where something changed
    withdrawn: list[
        Document
    ]  #: what was told before and holds no more, or is not what the filters ask for any more
    after: str  #: behind the last of them: what `follow_changes` takes to go on from here


class Event(TypedDict):
    """What happened, a CloudEvents 1.0 document."""

    specversion: Literal["1.0"]
    id: str  #: the same on every way, and however often it is delivered
    sequence: str  #: in the order of publication; what `events(after=)` takes
    type: str  #: such as `survey.ready`
    source: str  #: such as `/maps/lobby`
    time: str  #: RFC 3339
    subject: NotRequired[str]
    data: dict[str, Any]  #: ids and links; the things themselves are asked for


class Webhook(TypedDict):
    """An address that events are sent to."""

    webhook_id: str
    url: str
    types: list[str] | None  #: None: all
    map_id: str | None  #: None: of all maps, and of none
    status: Literal["active", "disabled"]
    reason: str | None  #: why it is disabled, or what it missed
    position: int  #: `sequence` of the last event that it needs no more
    attempts: int  #: that failed, at the event behind that


class NewWebhook(Webhook):
    """The same, as it is told once: when it is made, and when its secret is changed."""

    secret: str  #: what the signatures are made with, `whsec_...` (Standard Webhooks)


class Delivery(TypedDict):
    """One event that was sent to a webhook, or is to be."""

    delivery_id: str
    webhook_id: str
    kind: Literal["event", "ping", "repeat"]
    event_id: str
    type: str
    status: Literal["pending", "delivered", "failed"]
    attempts: int
    answered: int | None  #: HTTP status of the last answer
    error: str | None  #: why the last attempt failed


def event_of(told: ServerSentEvent) -> Event:
    """Return the event of a server-sent one. Raises ClientError where its data is no JSON object."""
    try:
        document = json.loads(told.data)
    except ValueError:
        document = None
    if not isinstance(document, dict):
        raise ClientError("an event came that is no JSON object; is this the service?")
    return cast(Event, document)


def changes_page(page: TileCollection) -> ChangesPage:
    """Return a page with the cursor behind it. Raises ClientError where it has none."""
    after = page.get("cursor")
    if not after:
        raise ClientError(
            "the service does not tell changes in the order of their publication; is it 0.2 or later?"
        )
    withdrawn = cast(Document, page).get("withdrawn", [])
    return ChangesPage(features=page["features"], withdrawn=withdrawn, after=after)
