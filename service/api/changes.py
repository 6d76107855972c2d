"""/maps/{id}/changes: what a dashboard asks, over all visits to a map."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from fastapi import Request as HttpRequest
from fastapi.responses import Response
from pydantic import Field

from service.api.gis import features
from service.api.gis.boxes import bounds_of
from service.api.gis.features import FeatureResponse, FeaturesRequest, Form, collection_response, form_of
from service.api.gis.feeds import After, feed_response, require_alone
from service.api.http.answering.documents import link
from service.api.http.answering.paging import Cursor, decoded_values, encoded_values
from service.api.http.answering.problems import documented
from service.api.http.dependencies import Provided
from service.api.http.reading.fields import DeviceId, Id, instant, readable
from service.api.tiles import (
    TILES,
    Bbox,
    BboxCrs,
    FgTileCollection,
    TileCollection,
    VoxelKinds,
    feature,
)
from service.catalog.catalog import Catalog
from service.catalog.findings.changes import ChangeFilter, ChangeSort, change_order
from service.catalog.following.events import FeedCursor
from service.catalog.records import Anchor, ChangeRecord, TileState
from service.errors import NotFound

router = APIRouter(tags=["changes"])

Span = tuple[datetime | None, datetime | None]  #: first and last instant, None where open


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


class ChangesRequest(FeaturesRequest):
    """Which changed tiles."""

    change: Annotated[
        Id | None, Field(description="this change alone, by its `change_id`", examples=["change-5c1d"])
    ] = None
    survey: Annotated[
        Id | None, Field(description="of this survey only, also what an earlier visit found before")
    ] = None
    repeats: Annotated[
        bool, Field(description="a feature for each visit that saw a change, and not one for each change")
    ] = False
    state: Annotated[
        TileState,
        Field(
            description="of the tiles; another one than `changed` is told for each visit, as with `repeats`"
        ),
    ] = "changed"
    kind: VoxelKinds = None
    device_id: Annotated[
        DeviceId | None,
        Field(description="of the visit; of a change that is told once: of one of the visits that saw it"),
    ] = None
    bbox: Bbox = None
    bbox_crs: BboxCrs = None
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
    sortby: Annotated[
        ChangeSort | None,
        Field(
            description="left out: newest first, by `first_seen`, or with `survey`, `repeats` or another `state` by "
            "`captured_at`, and the most certain first within a visit; with a minus downwards"
        ),
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
        **features.documented(TileCollection, FgTileCollection),
        **documented("not_found", "not_ready", "failed", "gone", "invalid_request", "bad_request"),
    },
)
def get_changes(
    request: HttpRequest,
    services: Provided,
    map_id: Annotated[Id, Path()],
    asked: Annotated[ChangesRequest, Query()],
) -> Response:
    """The changed tiles of every finished survey, each change once: newest first, most certain first within a visit.

    A change that stays over several visits is one feature, that of the visit which told it first, with `first_seen`,
    `last_seen` and `max_score` over all of them. It ends where a visit sees the tile unchanged, or a version of the map
    takes it over; a change after that is another one.

    With `after` those that were published since an earlier answer, in the order of publication: each once, whatever the
    order in which surveys come in, so that a visit which is uploaded late is not missed; and again with `updated` where
    something of it changed.

    A survey that still runs or failed has no say here; asked for by name it answers 409 and not an empty list,
    for nothing found is not the same as no change.
    """
    catalog = services.catalog
    anchor = catalog.maps.ready(map_id).anchor
    if asked.survey is not None:
        _require_survey(catalog, asked.survey, map_id)
    form, wanted = form_of(request, asked, anchor), _filter(map_id, asked, anchor)
    of_map = link(request, f"/maps/{map_id}", "map")
    if asked.after is not None:
        require_alone(
            after=asked.after,
            cursor=asked.cursor,
            survey=asked.survey,
            repeats=asked.repeats,
            sortby=asked.sortby,
            state=asked.state != "changed",
        )
        feed = catalog.changes.published(wanted, after=FeedCursor.read(asked.after), limit=asked.limit)
        return feed_response(request, form, TILES, feed, _change, links=[of_map])
    sort, order = asked.sortby, change_order(wanted, asked.sortby)
    after = decoded_values(asked.cursor, sort or "", [key.type for key in order], wanted)
    page = catalog.changes.page(wanted, sort=sort, after=after, limit=asked.limit)
    return collection_response(
        request,
        form,
        TILES,
        [(_change if wanted.once else feature)(change, form) for change in page.items],
        matched=page.matched,
        cursor=encoded_values(sort or "", page.following, wanted),
        links=[of_map],
    )


def _change(change: ChangeRecord, form: Form) -> dict[str, Any]:
    """Return a change that is told once, under its own id: the tile that stands for it may become another survey's."""
    return feature(change, form) | {"id": change.change_id}


def _filter(map_id: str, asked: ChangesRequest, anchor: Anchor | None) -> ChangeFilter:
    """Return which tiles are asked for, of a map that lies at `anchor`. Raises BadRequest."""
    since, until = (None, None) if asked.datetime is None else span_of(asked.datetime)
    return ChangeFilter(
        map_id=map_id,
        change_id=asked.change,
        survey_id=asked.survey,
        repeats=asked.repeats,
        state=asked.state,
        kind=asked.kind,
        device_id=asked.device_id,
        bounds=bounds_of(asked.bbox, asked.bbox_crs, anchor),
        since=since,
        until=until,
        min_score=asked.min_score,
    )


def _require_survey(catalog: Catalog, survey_id: str, map_id: str) -> None:
    """Raise NotFound for a survey of another map, before anything is told of it, and NotReady."""
    try:
        is_of_map = catalog.surveys.get(survey_id).map_id == map_id
    except NotFound:
        is_of_map = False
    if not is_of_map:
        raise NotFound(f"no survey {survey_id!r} of map {map_id!r}")
    catalog.surveys.ready(survey_id)
