"""/surveys/{id}/objects and /maps/{id}/objects: the things that appeared, disappeared or moved, and what became of them.

Answers are written as they are built, like those of `service.api.features`; a test holds them against the schema.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query
from fastapi import Request as HttpRequest
from pydantic import Field
from pydantic_core import to_json

from service.api import features
from service.api.changes import bounds_of, readable, span_of
from service.api.features import (
    MEDIA_TYPE,
    FeatureResponse,
    Footprint,
    Position2,
    Prism,
    Time,
    on_earth,
    plain,
)
from service.api.feeds import (
    FEED_CURSOR,
    FEED_WITHDRAWN,
    After,
    WithdrawnDocument,
    feed_links,
    feed_members,
    require_alone,
)
from service.api.geodesy import ToWgs84, to_wgs84
from service.api.http.dependencies import Provided
from service.api.http.documents import Document, Link, Request, link
from service.api.http.fields import Id, instant
from service.api.http.paging import Cursor, count, decoded, encoded, next_link
from service.api.http.problems import MADE, documented
from service.catalog.events import FeedCursor
from service.catalog.objects import ObjectFilter, SightingFilter
from service.catalog.records import (
    Anchor,
    MapObjectRecord,
    ObjectKind,
    ObjectStatus,
    Position,
    SightingRecord,
    Vector3,
    rfc3339,
)
from service.catalog.tables import now
from service.errors import NotFound
from service.object_features import (
    FEATURE_TYPE,
    object_collection,
    object_feature,
    ring_of,
    sighting_feature,
)
from service.tile_features import CONFORMS_TO, MAP_FRAME

router = APIRouter(tags=["objects"])
Limit = Annotated[int, Field(ge=1, le=10000, description="most features in one answer")]
MinProbability = Annotated[
    float | None, Field(ge=0, le=1, description="mean probability of change over the object")
]


class Box(Document):
    """Where a thing stands or stood: an upright box in the map's frame, metres, and what lies in it."""

    center: Vector3 = Field(examples=[[6.75, 3.75, 0.45]])
    size: Vector3 = Field(
        description="along the axes of the box: two that lie level, then its height",
        examples=[[0.5, 0.5, 0.9]],
    )
    yaw_degrees: float = Field(
        description="counter-clockwise, from the map's x axis to the first axis of the box", examples=[30.0]
    )
    footprint: tuple[Position2, ...] = Field(
        description="outline from above, counter-clockwise and closed",
        examples=[[[6.5, 3.5], [7.0, 3.5], [7.0, 4.0], [6.5, 4.0], [6.5, 3.5]]],
    )
    height_over_floor: float | None = Field(
        description="of its lower side, metres; null where no floor was seen", examples=[0.0]
    )
    volume: float = Field(description="cubic metres, of the convex hull of what was seen", examples=[0.06])
    voxels: int = Field(examples=[480])
    points: int = Field(examples=[1950])
    tiles: tuple[str, ...] = Field(
        description="ids of the tiles that it touches", examples=[["tile_004_002_000"]]
    )


class Move(Document):
    """How a thing was moved: turned about its upright axis, then shifted."""

    translation: Vector3 = Field(
        description="metres, from the earlier center to the later one", examples=[[1.2, 0.0, 0.0]]
    )
    yaw_degrees: float | None = Field(
        description="counter-clockwise; null where the thing is round", examples=[90.0]
    )


class SightingProperties(Document):
    """What one survey says of a thing."""

    object_id: str | None = Field(
        description="the same in every survey that saw it", examples=["object-7d21"]
    )
    number: int = Field(description="within the survey, as in its coloured cloud", examples=[1])
    kind: ObjectKind = Field(examples=["appeared"])
    now: Box | None = Field(description="where it is; null where it disappeared")
    before: Box | None = Field(description="where the map has it; null where it appeared")
    motion: Move | None = Field(description="of what moved")
    probability: float = Field(description="of change, mean over its voxels", examples=[0.96])
    observed_share: float = Field(description="of it, that both visits could judge", examples=[0.8])
    scans_seen_through: int = Field(
        description="scans of the other visit that saw through where it is", examples=[3]
    )
    map_id: str = Field(examples=["lobby"])
    map_version: int = Field(description="that the survey was compared with", examples=[1])
    survey_id: str = Field(examples=["survey-91c4"])
    model: str = Field(examples=["voxel-net/1"])
    captured_at: str = Field(examples=["2026-03-01T12:00:00Z"])
    first_seen: str | None = Field(
        description="by any survey; the survey's own time where it is the first",
        examples=["2026-03-01T12:00:00Z"],
    )


class ObjectProperties(SightingProperties):
    """What all surveys together say of a thing; what is of one survey is that of the latest which saw it."""

    status: ObjectStatus = Field(
        description="`new`: seen by the latest survey for the first time; `still_there`: by the latest and an earlier "
        "one; `gone_again`: the latest looked, and it is as in the map; `unknown`: the latest did not look there; "
        "`accepted`: a version of the map has taken it over",
        examples=["still_there"],
    )
    last_known: ObjectStatus = Field(
        description="the same as the latest survey that looked there told it", examples=["still_there"]
    )
    transient: bool = Field(
        description="it comes and goes: it was seen, gone and seen again, and not by three looks in a row since",
        examples=[False],
    )
    last_seen: str = Field(examples=["2026-03-08T12:00:00Z"])
    last_looked: str = Field(
        description="the latest survey that could judge its place", examples=["2026-03-08T12:00:00Z"]
    )
    accepted_in_version: int | None = Field(description="of the map, that has taken it over", examples=[None])
    sightings: int = Field(description="surveys that saw it", examples=[2])


class Interval(Document):
    """From the first sighting to the last."""

    interval: tuple[str, str] = Field(examples=[["2026-03-01T12:00:00Z", "2026-03-08T12:00:00Z"]])


class _Feature(Document):
    """What features of things have in common."""

    type: Literal["Feature"] = "Feature"
    geometry: Footprint | None = Field(description="WGS 84; null where the map has no geo-anchor")
    place: Prism = Field(description="where it is now, or was before where it disappeared")


class SightingFeature(_Feature):
    """A thing as one survey saw it."""

    id: str = Field(examples=["survey-91c4.object_1"])
    time: Time
    properties: SightingProperties


class ObjectFeature(_Feature):
    """A thing over all surveys of a map."""

    id: str = Field(examples=["object-7d21"])
    time: Interval
    properties: ObjectProperties


class ObjectHistory(ObjectFeature):
    """A thing over all surveys of a map, with each sighting of it."""

    sightings: list[SightingFeature] = Field(description="in order of time")
    links: list[Link]


class _Collection(Document):
    """The members that hold for all stand on the root, as the standard has it."""

    type: Literal["FeatureCollection"] = "FeatureCollection"
    conformsTo: tuple[str, ...] = CONFORMS_TO  # noqa: N815 - the standard's name
    featureType: str = FEATURE_TYPE  # noqa: N815
    coordRefSys: str = MAP_FRAME  # noqa: N815
    timeStamp: str = Field(examples=["2026-03-01T12:05:00Z"])  # noqa: N815
    numberMatched: int = Field(examples=[1])  # noqa: N815
    numberReturned: int = Field(examples=[1])  # noqa: N815
    links: list[Link]


class SightingCollection(_Collection):
    """The things that one survey found changed."""

    features: list[SightingFeature]


class ObjectCollection(_Collection):
    """The changed things of a map."""

    features: list[ObjectFeature]
    cursor: str | None = FEED_CURSOR
    withdrawn: list[WithdrawnDocument] | None = FEED_WITHDRAWN


class SightingsRequest(Request):
    """Which objects of a survey."""

    kind: ObjectKind | None = None
    min_probability: MinProbability = None
    limit: Limit = 100
    cursor: Cursor = None


class ObjectsRequest(Request):
    """Which objects of a map."""

    kind: Annotated[ObjectKind | None, Field(description="as its latest sighting tells it")] = None
    status: Annotated[ObjectStatus | None, Field(description="as of the latest survey")] = None
    last_known: Annotated[
        ObjectStatus | None, Field(description="as of the latest survey that looked there")
    ] = None
    transient: Annotated[
        bool | None, Field(description="true: what comes and goes; false: what does not")
    ] = None
    bbox: Annotated[
        Annotated[str, readable(bounds_of)] | None,
        Field(description="map frame, metres; objects whose box meets it", examples=["0,0,7.5,4.5"]),
    ] = None
    datetime: Annotated[
        Annotated[str, readable(span_of)] | None,
        Field(
            description="objects seen first before its end and last after its start: RFC 3339 instant, or interval "
            "with `..` for an open end",
            examples=["2026-03-01T00:00:00Z/.."],
        ),
    ] = None
    min_probability: MinProbability = None
    limit: Limit = 100
    cursor: Cursor = None
    after: After = None


@router.get(
    "/surveys/{survey_id}/objects",
    summary="The objects that a survey found changed",
    response_class=FeatureResponse,
    response_model=None,
    responses={
        **features.documented(SightingCollection),
        **documented("not_found", "not_ready", "invalid_request", "bad_request"),
    },
)
def get_survey_objects(
    request: HttpRequest,
    services: Provided,
    survey_id: Annotated[Id, Path()],
    asked: Annotated[SightingsRequest, Query()],
) -> FeatureResponse:
    """Things that appeared, disappeared or moved, by their number in the coloured cloud.

    A survey of a model that tells tiles alone has none to tell, nor has one whose placement is in doubt, which is not
    the same as none found: that is a 404.
    """
    catalog = services.catalog
    survey = catalog.surveys.ready(survey_id)
    if survey.objects is None:
        in_doubt = survey.placement is not None and survey.placement.state == "in_doubt"
        why = "its placement is in doubt" if in_doubt else f"{survey.model} tells tiles alone"
        raise NotFound(
            f"survey {survey_id!r} tells no objects, for {why}; GET /surveys/{survey_id}/tiles has those"
        )
    convert = _converter(catalog.maps.get(survey.map_id).anchor)
    wanted = SightingFilter(survey_id=survey_id, kind=asked.kind, min_probability=asked.min_probability)
    after = None if asked.cursor is None else int(decoded(asked.cursor, count)[0])
    page = catalog.objects.of_survey(wanted, after=after, limit=asked.limit)
    links = _links(request, None if page.following is None else encoded(str(page.following)))
    links.append(link(request, f"/surveys/{survey_id}", "survey"))
    return _answer([_sighting(one, convert) for one in page.items], page.matched, links)


@router.get(
    "/maps/{map_id}/objects",
    summary="The changed objects of a map over time",
    response_class=FeatureResponse,
    response_model=None,
    responses={
        **features.documented(ObjectCollection),
        **documented("not_found", "not_ready", "gone", "invalid_request", "bad_request"),
    },
)
def get_objects(
    request: HttpRequest,
    services: Provided,
    map_id: Annotated[Id, Path()],
    asked: Annotated[ObjectsRequest, Query()],
) -> FeatureResponse:
    """Each changed thing once, with what became of it: those first that were first seen last.

    A thing keeps its id from survey to survey. What a version of the map has taken over stays in the list as `accepted`.

    With `after` those that were published since an earlier answer, in the order of publication: each once, whatever the
    order in which surveys come in.
    """
    catalog = services.catalog
    convert = _converter(catalog.maps.ready(map_id).anchor)
    since, until = (None, None) if asked.datetime is None else span_of(asked.datetime)
    wanted = ObjectFilter(
        map_id=map_id,
        kind=asked.kind,
        status=asked.status,
        last_known=asked.last_known,
        transient=asked.transient,
        bounds=None if asked.bbox is None else bounds_of(asked.bbox),
        since=since,
        until=until,
        min_probability=asked.min_probability,
    )
    if asked.after is not None:
        require_alone(after=asked.after, cursor=asked.cursor)
        feed = catalog.objects.published(wanted, after=FeedCursor.read(asked.after), limit=asked.limit)
        links = [*feed_links(request, feed.cursor, MEDIA_TYPE), link(request, f"/maps/{map_id}", "map")]
        found = [_object(one, convert) for one in feed.items]
        return _answer(found, feed.matched, links, feed_members(feed.cursor, feed.withdrawn))
    page = catalog.objects.page(wanted, after=_position(asked.cursor), limit=asked.limit)
    links = _links(request, None if page.following is None else _cursor(page.following))
    links.append(link(request, f"/maps/{map_id}", "map"))
    return _answer([_object(one, convert) for one in page.items], page.matched, links)


@router.get(
    "/maps/{map_id}/objects/{object_id}",
    summary="One object with its history",
    response_class=FeatureResponse,
    response_model=None,
    responses=features.documented(ObjectHistory) | MADE,
)
def get_object(
    request: HttpRequest,
    services: Provided,
    map_id: Annotated[Id, Path()],
    object_id: Annotated[Id, Path()],
) -> FeatureResponse:
    """What became of it, and each sighting of it: where it was then, and what spoke for it."""
    catalog = services.catalog
    convert = _converter(catalog.maps.ready(map_id).anchor)
    record, seen = catalog.objects.get(map_id, object_id)
    here = f"/maps/{map_id}/objects/{object_id}"
    document = _object(record, convert) | {
        "sightings": [_sighting(one, convert) for one in seen],
        "links": [link(request, here, "self", MEDIA_TYPE), link(request, f"/maps/{map_id}", "map")],
    }
    return FeatureResponse(to_json(document, inf_nan_mode="null"))


def _answer(
    found: Iterable[dict[str, Any]],
    matched: int,
    links: Sequence[Link],
    members: Mapping[str, Any] | None = None,
) -> FeatureResponse:
    collection = object_collection(found, matched=matched)
    collection |= {"timeStamp": rfc3339(now()), "links": list(links), **(members or {})}
    return FeatureResponse(to_json(collection, inf_nan_mode="null"))


def _sighting(record: SightingRecord, convert: ToWgs84 | None) -> dict[str, Any]:
    """Return a sighting; `convert` takes points of the map frame to the Earth."""
    thing = record.thing.model_dump()
    return sighting_feature(thing, survey=_shared(record), geometry=_geometry(thing, convert))


def _object(record: MapObjectRecord, convert: ToWgs84 | None) -> dict[str, Any]:
    """Return an object as its latest sighting has it."""
    thing = record.latest.thing.model_dump()
    history = _shared(record.latest) | plain(record.model_dump(exclude={"latest"}))
    return object_feature(thing, history=history, geometry=_geometry(thing, convert))


def _shared(record: SightingRecord) -> dict[str, Any]:
    return plain(record.model_dump(exclude={"thing"}))


def _geometry(thing: dict[str, Any], convert: ToWgs84 | None) -> dict[str, Any] | None:
    return None if convert is None else on_earth(*ring_of(thing), convert)


def _converter(anchor: Anchor | None) -> ToWgs84 | None:
    return None if anchor is None else to_wgs84(anchor)


def _links(request: HttpRequest, cursor: str | None) -> list[Link]:
    """Return the links to this answer and, where there is more, to the next page."""
    here = Link(href=str(request.url.replace(scheme="", netloc="")), rel="self", type=MEDIA_TYPE)
    return [here] if cursor is None else [here, next_link(request, cursor, MEDIA_TYPE)]


def _cursor(position: Position) -> str:
    first_seen, object_id = position
    return encoded(rfc3339(first_seen), object_id)


def _position(cursor: str | None) -> Position | None:
    """Return where to go on. Raises BadRequest."""
    if cursor is None:
        return None
    first_seen, object_id = decoded(cursor, instant, str)
    return first_seen, object_id
