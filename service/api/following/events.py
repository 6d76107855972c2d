"""/events: what happens, as a stream (Server-Sent Events) or as a list that may wait for it."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query
from fastapi import Request as HttpRequest
from fastapi.responses import JSONResponse, Response
from fastapi.sse import EventSourceResponse, format_sse_event
from pydantic import Field
from pydantic_core import to_json
from starlette.types import Receive, Scope, Send

from service.api.following.event_documents import CloudEvent
from service.api.http.answering.documents import Document, Link, Request, link
from service.api.http.answering.problems import documented
from service.api.http.dependencies import Provided
from service.api.http.guards.access import maps_of_key
from service.api.http.guards.listeners import Listeners
from service.api.http.reading.fields import Id
from service.catalog.following.events import EventFilter
from service.catalog.records import EventRecord, EventType
from service.cloud_events import cloud_event
from service.errors import BadRequest, Forbidden, Gone, Unavailable

router = APIRouter(tags=["events"])

KEEP_ALIVE_S = 15.0  #: between two signs of life (HTML Living Standard, Section 9.2.7)
LONGEST_S = 900.0  #: of one stream: its key is asked for again when it goes on
_RETRY_MS = 2000  #: after which a browser comes back
_PAGE = 100

#: How a stream is framed (HTML Living Standard, Section 9.2), for clients that read it themselves.
STREAM = (
    f"Entries with an empty line behind each. The first has no data: `id` is where the stream begins, `retry: {_RETRY_MS}` "
    "the milliseconds after which to come back. Then one entry for each event: `data` is a CloudEvent in JSON, on one "
    "line, `id` its `sequence`; there is no `event:`, so browsers hand all of them to `onmessage`. A quiet stream has "
    f"every {KEEP_ALIVE_S:g} s an entry of an empty comment (`:`) and an `id` without data: keep that `id` as well"
)

_Cursor = Annotated[str, Field(pattern=r"^[0-9]{1,18}$")]


class EventsRequest(Request):
    """Which events."""

    map: Annotated[Id | None, Field(description="of this map alone")] = None
    type: Annotated[
        tuple[EventType, ...], Field(description="of these types alone; may be given more than once")
    ] = ()
    after: Annotated[
        _Cursor | None,
        Field(
            description="published since: `sequence` of an event, or the `cursor` of an earlier answer; 0 is the "
            "beginning of what is kept; left out: from now on",
            examples=["1041"],
        ),
    ] = None
    wait: Annotated[
        float, Field(ge=0, le=60, description="seconds that a list waits where it would be empty")
    ] = 0
    limit: Annotated[int, Field(ge=1, le=1000, description="most events in one list")] = _PAGE


class EventList(Document):
    """Events in the order of publication."""

    events: list[CloudEvent]
    cursor: str = Field(
        description="what to give as `after` next time, with the same other parameters, also where nothing was found",
        examples=["1042"],
    )
    links: list[Link]


@router.get(
    "/events",
    summary="What happens",
    response_model=None,
    responses={
        200: {
            "description": "A list, or with `Accept: text/event-stream` a stream",
            "content": {
                "application/json": {"schema": {"$ref": "#/components/schemas/EventList"}},
                "text/event-stream": {"schema": {"type": "string", "description": STREAM}},
            },
        },
        **documented("not_found", "gone", "invalid_request", "bad_request", "unavailable"),
    },
)
async def get_events(
    request: HttpRequest,
    services: Provided,
    asked: Annotated[EventsRequest, Query()],
    last_event_id: Annotated[
        str | None, Header(max_length=40, description="of a stream that goes on; wins over `after`")
    ] = None,
) -> Response:
    """Every event once, in the order of publication, and none missed.

    With `Accept: text/event-stream` a stream (Server-Sent Events) that goes on for up to fifteen minutes; come back with
    `Last-Event-ID`, the `id` of the last entry, as browsers do by themselves. The first entry has no data: its `id` is
    where the stream begins, and `retry: 2000` says after how many milliseconds to come back. Then there is one entry for
    each event: `data` is a CloudEvent, `id` its `sequence`, and no `event:`, so that a browser hands it to `onmessage`. A
    quiet stream has every 15 seconds an entry of an empty comment and an `id` without data. Before a stream begins an id
    or cursor that is too old, or ahead of every event, is answered by 410 (`gone`): begin anew with `after=0`.

    Else a list, which waits for up to `wait` seconds where there is nothing yet. Without `after` it begins now, so that
    the `cursor` of a first answer is where to go on.

    A key that is bound to maps gets the events of those.
    """
    listeners = services.listeners
    listeners.require_room()
    wanted = _filter(request, asked)
    if asked.map is not None:
        await listeners.check_map(asked.map)
    given = last_event_id or asked.after
    cursor = await listeners.last() if given is None else _read(given)
    root = request.scope.get("root_path", "")
    if "text/event-stream" in request.headers.get("accept", "").lower():
        await listeners.next(
            cursor, wanted, limit=1, wait_s=0
        )  # a cursor that is gone is told before it begins
        return _Stream(listeners, cursor, wanted, root)
    with listeners.joined():
        page = await listeners.next(cursor, wanted, limit=asked.limit, wait_s=asked.wait)
    here = request.url.path.removeprefix(root)
    following = request.url.include_query_params(after=str(page.cursor))
    links = [
        link(request, f"{here}?{request.url.query}", "self"),
        link(request, f"{here}?{following.query}", "next"),
    ]
    answer = {  # an EventList
        "events": [cloud_event(event, root=root) for event in page.items],
        "cursor": str(page.cursor),
        "links": [one.model_dump() for one in links],
    }
    return JSONResponse(answer, headers={"Cache-Control": "no-store"})


def _filter(request: HttpRequest, asked: EventsRequest) -> EventFilter:
    """Return what is asked for, as far as the key may see it. Raises Forbidden."""
    allowed = maps_of_key(request)
    if allowed is not None and asked.map is not None and asked.map not in allowed:
        raise Forbidden(f"the key is bound to other maps than {asked.map!r}")
    maps = allowed if asked.map is None else (asked.map,)
    return EventFilter(
        types=frozenset(asked.type) if asked.type else None, maps=None if maps is None else frozenset(maps)
    )


def _read(cursor: str) -> int:
    """Read a cursor. Raises BadRequest."""
    if not (cursor.isascii() and cursor.isdigit() and len(cursor) <= 18):
        raise BadRequest(f"{cursor[:40]!r} is no number of an event; give `sequence`, `cursor` or 0")
    return int(cursor)


class _Stream(EventSourceResponse):
    """Events as they are published, each once, until the client goes or the service ends."""

    def __init__(self, listeners: Listeners, cursor: int, wanted: EventFilter, root: str) -> None:
        self._listeners, self._cursor, self._wanted, self._root = listeners, cursor, wanted, root
        super().__init__(self._chunks(), headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it, and count it among the listeners meanwhile."""
        with self._listeners.joined():
            await super().__call__(scope, receive, send)

    async def _chunks(self) -> AsyncIterator[bytes]:
        until = time.monotonic() + LONGEST_S
        yield format_sse_event(id=str(self._cursor), retry=_RETRY_MS)
        while time.monotonic() < until and not self._listeners.ended:
            try:
                page = await self._listeners.next(
                    self._cursor, self._wanted, limit=_PAGE, wait_s=KEEP_ALIVE_S
                )
            except Gone:
                return  # the client comes back, and is told
            except Unavailable:
                yield format_sse_event(comment="the database does not answer")
                return
            for event in page.items:
                yield self._chunk(event)
            self._cursor = page.cursor
            if not page.items:  # a sign of life, which moves the client's cursor as well
                yield format_sse_event(comment="", id=str(page.cursor))

    def _chunk(self, event: EventRecord) -> bytes:
        text = to_json(cloud_event(event, root=self._root)).decode()
        return format_sse_event(data_str=text, id=str(event.sequence))
