"""Following what happens: changes by cursor, events by SSE, and webhooks that have them sent."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import aclosing
from typing import Any, Literal

import anyio
import httpx
from httpx_sse import EventSource, ServerSentEvent

from service.client.asynchronous.connection import AsyncConnection
from service.client.documents import TileCollection
from service.client.feeds import (
    FROM_THE_START,
    ChangesPage,
    Delivery,
    Event,
    NewWebhook,
    Webhook,
    changes_page,
    event_of,
)
from service.client.requests import given, quoted


class AsyncFeeds(AsyncConnection):
    """The calls of a dashboard."""

    async def follow_changes(
        self, map_id: str, *, after: str | None = None, every_s: float = 5.0, **filters: Any
    ) -> AsyncIterator[ChangesPage]:
        """Yield the changes of a map as they are published, page by page, and wait for more without end.

        Whoever keeps `after` of each page once it is dealt with, and gives it back later, misses no change and sees
        none twice as new: with the property `updated` one comes again where something of it changed. Left out: all changes from the first on. Filters are those of the API.
        """
        path = f"/maps/{quoted(map_id)}/changes"
        cursor = FROM_THE_START if after is None else after
        while True:
            query = given(**filters, after=cursor)
            page = await self._json(TileCollection, "GET", path, params=query)
            told = changes_page(page)
            if told.features or told.withdrawn:
                yield told
            else:
                await anyio.sleep(every_s)
            cursor = told.after

    async def events(
        self, *, types: Sequence[str] = (), map_id: str | None = None, after: str | None = None
    ) -> AsyncIterator[Event]:
        """Yield what happens as it happens, without end; a connection that breaks is taken up behind the last event.

        `after` is the `sequence` of the last event that was dealt with, or "0" for the first that is kept; left out:
        from now on. Raises `Unreachable` once the service is away for longer than `retries` says, and
        `RequestRefused` (410) where what comes after `after` is not kept any more.
        """
        query = given(type=list(types) or None, map=map_id)
        last, fruitless = after, 0
        while True:
            async with aclosing(self._listen(query, last)) as stream:
                async for told in stream:
                    last, fruitless = told.id or last, 0
                    if told.data:  # a sign of life has none, and moves the cursor as well
                        yield event_of(told)
            fruitless += 1
            await anyio.sleep(self.retries.pause_s(fruitless))

    async def _listen(self, query: dict[str, Any], last: str | None) -> AsyncGenerator[ServerSentEvent, None]:
        """Yield what one connection tells until it ends or breaks."""
        headers = {"Accept": "text/event-stream", **given(**{"Last-Event-ID": last})}
        answer = await self._send("GET", "/events", params=query, headers=headers, stream=True)
        try:
            async for told in EventSource(answer).aiter_sse():
                yield told
        except httpx.TransportError:
            return  # taken up by who listens
        finally:
            await answer.aclose()

    async def create_webhook(
        self, url: str, *, types: Sequence[str] | None = None, map_id: str | None = None
    ) -> NewWebhook:
        """Have events sent to an address; the answer tells the secret of the signatures, now and never again."""
        body = given(url=url, types=None if types is None else list(types), map=map_id)
        return await self._json(NewWebhook, "POST", "/webhooks", json=body, keyed=False)

    async def webhooks(self) -> list[Webhook]:
        """Return every webhook."""
        return await self._all(Webhook, "/webhooks", "webhooks")

    async def webhook(self, webhook_id: str) -> Webhook:
        """Return one webhook."""
        return await self._json(Webhook, "GET", f"/webhooks/{quoted(webhook_id)}")

    async def delete_webhook(self, webhook_id: str) -> None:
        """Have no more events sent."""
        await self._delete(f"/webhooks/{quoted(webhook_id)}")

    async def change_webhook(
        self,
        webhook_id: str,
        *,
        url: str | None = None,
        types: Sequence[str] | None = None,
        status: Literal["active", "disabled"] | None = None,
    ) -> Webhook:
        """Change what is given; `types` of none are all. Switched on again, it gets what it missed meanwhile."""
        body = given(url=url, types=None if types is None else list(types), status=status)
        return await self._json(Webhook, "PATCH", f"/webhooks/{quoted(webhook_id)}", json=body)

    async def ping_webhook(self, webhook_id: str) -> Delivery:
        """Have an event sent that says nothing but that it arrives."""
        return await self._json(Delivery, "POST", f"/webhooks/{quoted(webhook_id)}/ping", keyed=False)

    async def rotate_webhook(self, webhook_id: str) -> NewWebhook:
        """Change the secret; for a day what is sent bears the signatures of both."""
        return await self._json(NewWebhook, "POST", f"/webhooks/{quoted(webhook_id)}/rotate", keyed=False)

    async def deliveries(self, webhook_id: str) -> list[Delivery]:
        """Return what was sent to a webhook, and what is still to be, newest first."""
        return await self._all(Delivery, f"/webhooks/{quoted(webhook_id)}/deliveries", "deliveries")

    async def repeat_delivery(self, webhook_id: str, delivery_id: str) -> Delivery:
        """Have an event sent once more, under the same id."""
        path = f"/webhooks/{quoted(webhook_id)}/deliveries/{quoted(delivery_id)}/repeat"
        return await self._json(Delivery, "POST", path, keyed=False)
