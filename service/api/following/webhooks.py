"""/webhooks: addresses that events are sent to, signed; and what was sent to each."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Response
from fastapi import Request as HttpRequest
from pydantic import Field

from service.api.http.answering.documents import Document, Link, Request, checked, link
from service.api.http.answering.paging import PageRequest, list_links
from service.api.http.answering.problems import BODY, documented, located
from service.api.http.dependencies import Provided
from service.api.http.guards.access import maps_of_key, require_map
from service.api.http.reading import bodies
from service.api.http.reading.fields import Id, Text
from service.api.http.reading.idempotency import KEYED, Keyed, answered
from service.api.http.reading.submission import delete
from service.catalog.idempotency import Answer
from service.catalog.records import DeliveryRecord, EventType, WebhookRecord
from service.webhooks.addresses import checked_url

router = APIRouter(tags=["webhooks"])

WebhookId = Annotated[Id, Path()]
Url = Annotated[
    Text,
    Field(
        min_length=1,
        max_length=2000,
        description="https, of a host of the public internet; of one in a network of SPICD_WEBHOOK_ALLOWED_NETWORKS http as "
        "well",
        examples=["https://example.org/hooks/spicd"],
    ),
]


class WebhookRequest(Request):
    """Where to send what."""

    url: Url
    types: Annotated[
        tuple[EventType, ...] | None,
        Field(
            min_length=1,
            description="left out: all, less `change.updated` and `object.updated` with `only_times`, which say with each "
            "visit that nothing is new; named they come too",
            examples=[["change.told", "change.withdrawn"]],
        ),
    ] = None
    map: Annotated[
        Id | None,
        Field(description="events of this map alone; a key that is bound to maps names one of them"),
    ] = None


class WebhookChange(Request):
    """What of a webhook becomes something else; what is left out stays."""

    url: Url | None = None
    types: Annotated[
        tuple[EventType, ...] | None,
        Field(description="an empty list: as left out of a new one", examples=[["change.told"]]),
    ] = None
    status: Annotated[
        Literal["active", "disabled"] | None,
        Field(description="`active`: it goes on behind the last event that it got"),
    ] = None


class WebhookDocument(WebhookRecord, Document):
    """A webhook, without its secret."""

    links: list[Link]


class NewWebhook(WebhookDocument):
    """A webhook with its secret, which is not shown again."""

    secret: str = Field(
        description="of the signatures (Standard Webhooks)", examples=["whsec_C2FVsBQIhrscChlQ"]
    )


class WebhookList(Document):
    """Webhooks, newest first."""

    webhooks: list[WebhookDocument]
    links: list[Link]


class DeliveryDocument(DeliveryRecord, Document):
    """A delivery."""

    links: list[Link]


class DeliveryList(Document):
    """Deliveries of a webhook, newest first."""

    deliveries: list[DeliveryDocument]
    links: list[Link]


@router.post(
    "/webhooks",
    status_code=201,
    summary="Have events sent to an address",
    responses={
        201: {
            "description": "The webhook, with its secret",
            "headers": located("/webhooks/webhook-2d7e", "webhook"),
        },
        **documented(*BODY, "not_found", "conflict", *KEYED),
    },
    openapi_extra=bodies.documented(json=WebhookRequest),
)
async def create_webhook(
    request: HttpRequest, response: Response, services: Provided, keyed: Keyed
) -> NewWebhook:
    """Each event that is published from now on is sent, one after the other, as a signed POST.

    The answer has the secret by which the receiver knows that it came from here, and nothing shows it again.
    """

    def accept(record: WebhookRecord, secret: str) -> Answer:
        made = NewWebhook(**_fields(request, record), secret=secret)
        return answered(made, status=201, headers=_kept_secret(request, record))

    async with bodies.received(request, services, takes=(bodies.JSON,), needs_space=False) as body:
        wanted, once = checked(WebhookRequest, body.fields), keyed.once(body, accept)
    require_map(request, wanted.map)
    url = checked_url(wanted.url, allowed=services.settings.webhook_networks())
    record, secret = await services.writes.run(
        services.catalog.webhooks.add, url, types=wanted.types, map_id=wanted.map, once=once
    )
    response.headers.update(_kept_secret(request, record))
    return NewWebhook(**_fields(request, record), secret=secret)


@router.get("/webhooks", summary="List webhooks", responses=documented("invalid_request", "bad_request"))
def list_webhooks(
    request: HttpRequest, services: Provided, asked: Annotated[PageRequest, Query()]
) -> WebhookList:
    """Webhooks, newest first; a key that is bound to maps sees those of its maps."""
    page = services.catalog.webhooks.page(maps=maps_of_key(request), after=asked.after(), limit=asked.limit)
    return WebhookList(
        webhooks=[_document(request, record) for record in page.items],
        links=list_links(request, asked, page, lambda record: (record.created, record.webhook_id)),
    )


@router.get(
    "/webhooks/{webhook_id}",
    summary="Look at a webhook",
    responses=documented("not_found", "invalid_request"),
)
def get_webhook(request: HttpRequest, services: Provided, webhook_id: WebhookId) -> WebhookDocument:
    """Where it leads, how far it is, and why it is disabled where it is."""
    return _document(request, services.catalog.webhooks.get(webhook_id))


@router.patch(
    "/webhooks/{webhook_id}",
    summary="Change a webhook",
    responses=documented(*BODY, "not_found"),
    openapi_extra=bodies.documented(json=WebhookChange),
)
async def change_webhook(request: HttpRequest, services: Provided, webhook_id: WebhookId) -> WebhookDocument:
    """What is left out stays. With `status` it is switched off, and on again: then it gets what it missed meanwhile."""
    async with bodies.received(request, services, takes=(bodies.JSON,), needs_space=False) as body:
        wanted = checked(WebhookChange, body.fields)
    url = wanted.url
    if url is not None:
        url = checked_url(url, allowed=services.settings.webhook_networks())
    record = await services.writes.run(
        services.catalog.webhooks.change,
        webhook_id,
        url=url,
        types=wanted.types,
        active=None if wanted.status is None else wanted.status == "active",
    )
    return _document(request, record)


@router.delete(
    "/webhooks/{webhook_id}",
    status_code=204,
    summary="Delete a webhook",
    responses=documented("not_found", "invalid_request"),
)
async def delete_webhook(services: Provided, webhook_id: WebhookId) -> None:
    """It gets nothing any more, and the list of its deliveries goes with it."""
    await delete(services, services.catalog.webhooks.delete, webhook_id)


@router.post(
    "/webhooks/{webhook_id}/ping",
    status_code=202,
    summary="Have a test sent to a webhook",
    responses=documented("not_found", "invalid_request"),
)
async def ping_webhook(request: HttpRequest, services: Provided, webhook_id: WebhookId) -> DeliveryDocument:
    """An event of the type `webhook.ping` is sent once, also to a webhook that is disabled."""
    return _delivery(request, await services.writes.run(services.catalog.webhooks.ping, webhook_id))


@router.post(
    "/webhooks/{webhook_id}/rotate",
    summary="Give a webhook another secret",
    responses=documented("not_found", "invalid_request", *KEYED),
)
async def rotate_secret(
    request: HttpRequest, response: Response, services: Provided, webhook_id: WebhookId, keyed: Keyed
) -> NewWebhook:
    """For a day what is sent has two signatures, by the new secret and by the one before."""

    def accept(record: WebhookRecord, secret: str) -> Answer:
        made = NewWebhook(**_fields(request, record), secret=secret)
        return answered(made, status=200, headers={"Cache-Control": "no-store"})

    record, secret = await services.writes.run(
        services.catalog.webhooks.rotate, webhook_id, once=keyed.once(None, accept)
    )
    response.headers["Cache-Control"] = "no-store"
    return NewWebhook(**_fields(request, record), secret=secret)


@router.get(
    "/webhooks/{webhook_id}/deliveries",
    summary="List what was sent to a webhook",
    responses=documented("not_found", "invalid_request", "bad_request"),
)
def list_deliveries(
    request: HttpRequest,
    services: Provided,
    webhook_id: WebhookId,
    asked: Annotated[PageRequest, Query()],
) -> DeliveryList:
    """What was sent and what waits, newest first, with what the receiver answered last."""
    page = services.catalog.webhooks.deliveries(webhook_id, after=asked.after(), limit=asked.limit)
    return DeliveryList(
        deliveries=[_delivery(request, record) for record in page.items],
        links=list_links(request, asked, page, lambda record: (record.created, record.delivery_id)),
    )


@router.post(
    "/webhooks/{webhook_id}/deliveries/{delivery_id}/repeat",
    status_code=202,
    summary="Have an event sent again",
    responses=documented("not_found", "gone", "invalid_request"),
)
async def repeat_delivery(
    request: HttpRequest, services: Provided, webhook_id: WebhookId, delivery_id: Annotated[Id, Path()]
) -> DeliveryDocument:
    """Once, under the same id, beside those whose turn it is."""
    repeat = services.catalog.webhooks.repeat
    return _delivery(request, await services.writes.run(repeat, webhook_id, delivery_id))


def _kept_secret(request: HttpRequest, record: WebhookRecord) -> dict[str, str]:
    """Return the headers of an answer that has a secret: nobody on the way keeps it."""
    return {"Location": _path(request, record.webhook_id), "Cache-Control": "no-store"}


def _path(request: HttpRequest, webhook_id: str) -> str:
    return link(request, f"/webhooks/{webhook_id}", "self").href


def _fields(request: HttpRequest, record: WebhookRecord) -> dict[str, Any]:
    here = f"/webhooks/{record.webhook_id}"
    links = [link(request, here, "self"), link(request, f"{here}/deliveries", "deliveries")]
    if record.map_id is not None:
        links.append(link(request, f"/maps/{record.map_id}", "map"))
    return {**dict(record), "links": links}


def _document(request: HttpRequest, record: WebhookRecord) -> WebhookDocument:
    return WebhookDocument(**_fields(request, record))


def _delivery(request: HttpRequest, record: DeliveryRecord) -> DeliveryDocument:
    here = f"/webhooks/{record.webhook_id}"
    links = [link(request, f"{here}/deliveries", "collection"), link(request, here, "webhook")]
    return DeliveryDocument(**dict(record), links=links)
