"""/maps/{id}/changes: what a dashboard asks, over all visits to a map."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Path, Query
from fastapi import Request as HttpRequest
from pydantic import AfterValidator, Field

from service.api import features
from service.api.features import FeatureResponse, feature_response
from service.api.feeds import After, feed_links, feed_members, require_alone
from service.api.http.dependencies import Provided
from service.api.http.documents import Link, Request, link
from service.api.http.fields import Id, instant
from service.api.http.paging import Cursor, decoded, encoded, finite, next_link
from service.api.http.problems import documented
from service.catalog.catalog import Catalog
from service.catalog.changes import ChangeFilter, ChangePosition
from service.catalog.events import FeedCursor
from service.catalog.records import Bounds, rfc3339
from service.errors import NotFound

router = APIRouter(tags=["changes"])

Span = tuple[datetime | None, datetime | None]  #: first and last instant, None where open


def bounds_of(bbox: str) -> Bounds:
    """Read four numbers (x and y) or six (x, y and z): the minimum corner, then the maximum. Raises ValueError."""
    try:
        numbers = [float(part) for part in bbox.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (4, 6) or not all(math.isfinite(number) for number in numbers):
        raise ValueError("give four or six numbers: minimum x,y[,z] then maximum x,y[,z], in metres")
    half = len(numbers) // 2
    low, high = numbers[:half], numbers[half:]
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise ValueError("the minimum corner comes first, then the maximum")
    if half == 2:
        low, high = [*low, -sys.float_info.max], [*high, sys.float_info.max]
    return Bounds(min=(low[0], low[1], low[2]), max=(high[0], high[1], high[2]))


def span_of(interval: str) -> Span:
    """Read an instant, or an interval with `..` (or nothing) for an open end (OGC API - Features, `datetime`).

    Raises ValueError.
    """
    parts = interval.split("/")
    if len(parts) > 2:
        raise ValueError("give an instant or an interval start/end")
    if len(parts) == 1:
        return (instant(interval),) * 2
    since, until = (None if part in ("", "..") else instant(part) for part in parts)
    if since is None and until is None:
        raise ValueError("an interval has at least one end; leave datetime out to take all")
    if since is not None and until is not None and since > until:
        raise ValueError("the interval ends before it starts")
    return since, until


def readable(read: Callable[[str], object]) -> AfterValidator:
    """Check a text with `read`, and leave it a text: a query parameter of many parts is taken for a list."""

    def check(text: str) -> str:
        read(text)
        return text

    return AfterValidator(check)


class ChangesRequest(Request):
    """Which changed tiles."""

    survey: Annotated[
        Id | None, Field(description="of this survey only, also what an earlier visit found before")
    ] = None
    repeats: Annotated[
        bool, Field(description="a feature for each visit that saw a change, and not one for each change")
    ] = False
    bbox: Annotated[
        Annotated[str, readable(bounds_of)] | None,
        Field(description="map frame, metres; tiles whose box meets it", examples=["0,0,7.5,4.5"]),
    ] = None
    datetime: Annotated[
        Annotated[str, readable(span_of)] | None,
        Field(
            description="in which a change was first seen; with `survey` or `repeats` that of the visit: RFC 3339 "
            "instant, or interval with `..` for an open end",
            examples=["2026-03-01T00:00:00Z/.."],
        ),
    ] = None
    min_score: Annotated[
        float | None,
        Field(ge=0, le=1, description="probability of change, in one at least of the visits that saw it"),
    ] = None
    limit: Annotated[int, Field(ge=1, le=10000, description="most features in one answer")] = 100
    cursor: Cursor = None
    after: After = None


@router.get(
    "/maps/{map_id}/changes",
    summary="What changed",
    response_class=FeatureResponse,
    response_model=None,
    responses={
        **features.documented(),
        **documented("not_found", "not_ready", "gone", "invalid_request", "bad_request"),
    },
)
def get_changes(
    request: HttpRequest,
    services: Provided,
    map_id: Annotated[Id, Path()],
    asked: Annotated[ChangesRequest, Query()],
) -> FeatureResponse:
    """The changed tiles of every finished survey, each change once: newest first, most certain first within a visit.

    A change that stays over several visits is one feature, that of the visit which told it first, with `first_seen`,
    `last_seen` and `max_score` over all of them. It ends where a visit sees the tile unchanged, or a version of the map
    takes it over; a change after that is another one.

    With `after` those that were published since an earlier answer, in the order of publication: each once, whatever the
    order in which surveys come in, so that a visit which is uploaded late is not missed.

    A survey that still runs or failed has no say here; asked for by name it answers 409 and not an empty list,
    for nothing found is not the same as no change.
    """
    catalog = services.catalog
    anchor = catalog.maps.ready(map_id).anchor
    if asked.survey is not None:
        _require_survey(catalog, asked.survey, map_id)
    since, until = (None, None) if asked.datetime is None else span_of(asked.datetime)
    wanted = ChangeFilter(
        map_id=map_id,
        survey_id=asked.survey,
        repeats=asked.repeats,
        bounds=None if asked.bbox is None else bounds_of(asked.bbox),
        since=since,
        until=until,
        min_score=asked.min_score,
    )
    if asked.after is not None:
        require_alone(after=asked.after, cursor=asked.cursor, survey=asked.survey, repeats=asked.repeats)
        feed = catalog.changes.published(wanted, after=FeedCursor.read(asked.after), limit=asked.limit)
        links = feed_links(request, feed.cursor, features.MEDIA_TYPE)
        links.append(link(request, f"/maps/{map_id}", "map"))
        members = feed_members(feed.cursor, feed.withdrawn)
        return feature_response(feed.items, matched=feed.matched, links=links, anchor=anchor, members=members)
    page = catalog.changes.page(wanted, after=position_of(asked.cursor), limit=asked.limit)
    links = [
        Link(href=str(request.url.replace(scheme="", netloc="")), rel="self", type=features.MEDIA_TYPE),
        link(request, f"/maps/{map_id}", "map"),
    ]
    if page.following is not None:
        links.append(next_link(request, cursor_of(page.following), features.MEDIA_TYPE))
    return feature_response(page.items, matched=page.matched, links=links, anchor=anchor)


def _require_survey(catalog: Catalog, survey_id: str, map_id: str) -> None:
    """Raise NotFound for a survey of another map, before anything is told of it, and NotReady."""
    try:
        is_of_map = catalog.surveys.get(survey_id).map_id == map_id
    except NotFound:
        is_of_map = False
    if not is_of_map:
        raise NotFound(f"no survey {survey_id!r} of map {map_id!r}")
    catalog.surveys.ready(survey_id)


def cursor_of(position: ChangePosition) -> str:
    """Return the cursor behind a change."""
    return encoded(rfc3339(position.instant), position.survey_id, position.score.hex(), position.tile_id)


def position_of(cursor: str | None) -> ChangePosition | None:
    """Return where to go on. Raises BadRequest."""
    if cursor is None:
        return None
    return ChangePosition(*decoded(cursor, instant, str, finite, str))
