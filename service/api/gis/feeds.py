"""Lists in the order of publication: a reader gives the cursor of the last answer, and misses and repeats nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, TypeVar

from fastapi import Request as HttpRequest
from fastapi.responses import Response
from pydantic import AfterValidator, Field

from service.api.gis.features import Form, Kind, collection_response
from service.api.http.answering.documents import Document, Link, link
from service.catalog.following.events import FeedCursor, Published, Withdrawn
from service.errors import BadRequest

T = TypeVar("T")


def _checked(text: str) -> str:
    FeedCursor.read(text)
    return text


After = Annotated[
    Annotated[str, AfterValidator(_checked)] | None,
    Field(
        description="what was published since: the `cursor` of an earlier answer with the same filters, or 0 for the "
        "beginning; the order is then that of publication, `updated` ones first",
        examples=["0"],
    ),
]

FEED_CURSOR = Field(
    None,
    description="with `after` alone: what to give as `after` next time, here and not at /events, also where nothing was "
    "found. While there is more the answer has a link `next`; at the end it has `monitor` instead, to ask again later",
)
FEED_WITHDRAWN = Field(
    None,
    description="with `after` alone: what was told before and is not any more, or is not what the filters ask for any "
    "more; ids that you have not had may be among them",
)
FEED_UPDATED = Field(
    None,
    description="with `after` alone: whether it was told before the cursor and comes again because something of it "
    "changed, `last_seen` for instance; it takes the place of what you have under the same `id`. With filters it may be "
    "new to you all the same, where it was not what they ask for until now",
)


class WithdrawnDocument(Document):
    """Something that is told no more: a survey was deleted, or a late visit joined two into one."""

    id: str = Field(examples=["change-5c02"])
    merged_into: str | None = Field(
        description="the change that it turned out to be", examples=["change-11fe"]
    )
    filtered: bool = Field(
        description="it is still told, and not what the filters ask for any more", examples=[False]
    )


def require_alone(**asked: object) -> None:
    """Raise BadRequest where `after` comes with a parameter that has another order or another identity."""
    others = [name for name, value in asked.items() if name != "after" and value]
    if others:
        raise BadRequest(f"after goes in the order of publication, and not together with {others[0]}")


def feed_response(
    request: HttpRequest,
    form: Form,
    kind: Kind,
    feed: Published[T],
    feature: Callable[[T, Form], Mapping[str, Any]],
    *,
    links: Iterable[Link],
) -> Response:
    """Answer with what was published behind a cursor, each item as `feature` makes it, and where to go on."""
    return collection_response(
        request,
        form,
        kind,
        [_marked(feature(one, form), number < feed.updated) for number, one in enumerate(feed.items)],
        matched=feed.matched,
        following=_feed_next(request, feed, form.media_type),
        links=links,
        members=_feed_members(feed.cursor, feed.withdrawn),
    )


def _marked(feature: Mapping[str, Any], updated: bool) -> Mapping[str, Any]:
    return {**feature, "properties": {**feature["properties"], "updated": updated}}


def _feed_next(request: HttpRequest, feed: Published[Any], media_type: str) -> Link:
    """Return the link to what is behind an answer; where that is nothing yet, to where it will be (RFC 5989)."""
    path = request.url.path.removeprefix(request.scope.get("root_path", ""))
    following = request.url.include_query_params(after=str(feed.cursor))
    return link(request, f"{path}?{following.query}", "next" if feed.more else "monitor", media_type)


def _feed_members(cursor: FeedCursor, withdrawn: Iterable[Withdrawn]) -> dict[str, Any]:
    """Return the members of an answer that a reader goes on by."""
    gone = [
        {"id": one.subject, "merged_into": one.merged_into, "filtered": one.filtered} for one in withdrawn
    ]
    return {"cursor": str(cursor), "withdrawn": gone}
