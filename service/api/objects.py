"""/surveys/{id}/objects and /maps/{id}/objects: the things that appeared, disappeared or moved, and what became of them.

Answers are written as they are built, like those of `service.api.gis.features`; a test holds them against the schema.
"""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from fastapi import Request as HttpRequest
from fastapi.responses import Response
from pydantic import Field

from service.api.changes import span_of
from service.api.gis import features
from service.api.gis.boxes import bounds_of
from service.api.gis.features import (
    FeatureResponse,
    FeaturesRequest,
    FgCollection,
    Form,
    GeoJsonCollection,
    GeoJsonFeature,
    Kind,
    Position2,
    Prism,
    Time,
    collection_response,
    feature_response,
    form_of,
    plain,
)
from service.api.gis.feeds import (
    FEED_CURSOR,
    FEED_UPDATED,
    FEED_WITHDRAWN,
    After,
    WithdrawnDocument,
    feed_response,
    require_alone,
)
from service.api.http.answering.documents import Document, Link, link
from service.api.http.answering.paging import Cursor, decoded_values, encoded_values
from service.api.http.answering.problems import MADE, documented
from service.api.http.dependencies import Provided
from service.api.http.reading.fields import DeviceId, Id, readable
from service.api.tiles import Bbox, BboxCrs
from service.catalog.findings.objects import (
    ObjectFilter,
    ObjectSort,
    SightingFilter,
    SightingSort,
    object_order,
    sighting_order,
)
from service.catalog.following.events import FeedCursor
from service.catalog.records import (
    Anchor,
    MapObjectRecord,
    ObjectKind,
    ObjectStatus,
    SightingRecord,
    SurveyRecord,
    Vector3,
)
from service.errors import NotFound
from service.object_features import FEATURE_TYPE, object_feature, ring_of, sighting_feature

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
        description="counter-clockwise; null where the thing is round, or no survey compared both places",
        examples=[90.0],
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
    center_x: float = Field(
        description="where it is, or was before: this and the next numbers say again what `now`, `before` and `motion` "
        "say, each by itself (metres, map frame)",
        examples=[6.75],
    )
    center_y: float = Field(examples=[3.75])
    z_min: float = Field(examples=[0.0])
    z_max: float = Field(examples=[0.9])
    size_x: float = Field(description="along the axes of the box, not of the map", examples=[0.5])
    size_y: float = Field(examples=[0.5])
    size_z: float = Field(examples=[0.9])
    yaw_degrees: float = Field(examples=[30.0])
    height_over_floor: float | None = Field(examples=[0.0])
    volume: float = Field(description="cubic metres", examples=[0.06])
    moved_x: float | None = Field(description="of what moved, like the next three", examples=[None])
    moved_y: float | None = Field(examples=[None])
    moved_z: float | None = Field(examples=[None])
    moved_yaw_degrees: float | None = Field(examples=[None])
    probability: float = Field(description="of change, mean over its voxels", examples=[0.96])
    observed_share: float = Field(description="of it, that both visits could judge", examples=[0.8])
    scans_seen_through: int = Field(
        description="scans of the other visit that saw through where it is", examples=[3]
    )
    map_id: str = Field(examples=["lobby"])
    map_version: int = Field(description="that the survey was compared with", examples=[1])
    survey_id: str = Field(examples=["survey-91c4"])
    device_id: str | None = Field(description="of the survey", examples=["robot-7"])
    model: str = Field(examples=["voxel-net/1"])
    captured_at: str = Field(examples=["2026-03-01T12:00:00Z"])
    first_seen: str | None = Field(
        description="by any survey; the survey's own time where it is the first",
        examples=["2026-03-01T12:00:00Z"],
    )


class ObjectProperties(SightingProperties):
    """What all surveys together say of a thing.

    `kind`, `now` and `before` are of what stands: a place that the latest survey did not look at is as an earlier one told
    it. What else is of one survey is of the latest which saw the thing.
    """

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
    updated: bool | None = FEED_UPDATED


class Interval(Document):
    """From the first sighting to the last."""

    interval: tuple[str, str] = Field(examples=[["2026-03-01T12:00:00Z", "2026-03-08T12:00:00Z"]])


class SightingFeature(GeoJsonFeature):
    """A thing as one survey saw it; its footprint is where it is now, or was before where it disappeared."""

    id: str = Field(examples=["survey-91c4.object_1"])
    properties: SightingProperties


class ObjectFeature(GeoJsonFeature):
    """A thing over all surveys of a map; its footprint is where it was seen last, or was before where it disappeared."""

    id: str = Field(examples=["object-7d21"])
    properties: ObjectProperties


class ObjectHistory(ObjectFeature):
    """A thing over all surveys of a map, with each sighting of it."""

    crs: features.NamedCrs | None = Field(None, description="with `crs=map` alone")
    sightings: list[SightingFeature] = Field(description="one of each survey that saw it, in order of time")
    links: list[Link]


class SightingCollection(GeoJsonCollection):
    """The things that one survey found changed."""

    features: list[SightingFeature]


class ObjectCollection(GeoJsonCollection):
    """The changed things of a map."""

    features: list[ObjectFeature]
    cursor: str | None = FEED_CURSOR
    withdrawn: list[WithdrawnDocument] | None = FEED_WITHDRAWN


class FgSightingFeature(SightingFeature):
    """A thing as one survey saw it, in JSON-FG."""

    place: Prism
    time: Time


class FgObjectFeature(ObjectFeature):
    """A thing over all surveys of a map, in JSON-FG."""

    place: Prism
    time: Interval


class FgObjectHistory(FgObjectFeature):
    """A thing over all surveys of a map, with each sighting of it, in JSON-FG."""

    sightings: list[FgSightingFeature] = Field(description="one of each survey that saw it, in order of time")
    links: list[Link]


class FgSightingCollection(FgCollection):
    """The things that one survey found changed, in JSON-FG."""

    features: list[FgSightingFeature]


class FgObjectCollection(FgCollection):
    """The changed things of a map, in JSON-FG."""

    features: list[FgObjectFeature]
    cursor: str | None = FEED_CURSOR
    withdrawn: list[WithdrawnDocument] | None = FEED_WITHDRAWN


#: What the routes below answer with, which FastAPI does not see.
DOCUMENTS: tuple[type[Document], ...] = (
    SightingCollection,
    ObjectCollection,
    ObjectHistory,
    FgSightingCollection,
    FgObjectCollection,
    FgObjectHistory,
)

_NESTED = {"now", "before", "motion"}
SIGHTINGS, OBJECTS = (
    Kind(feature_type=FEATURE_TYPE, columns=tuple(name for name in shown.model_fields if name not in _NESTED))
    for shown in (SightingProperties, ObjectProperties)
)


class SightingsRequest(FeaturesRequest):
    """Which objects of a survey."""

    kind: ObjectKind | None = None
    min_probability: MinProbability = None
    bbox: Bbox = None
    bbox_crs: BboxCrs = None
    sortby: Annotated[SightingSort, Field(description="with a minus downwards")] = "number"
    limit: Limit = 100
    cursor: Cursor = None


class ObjectsRequest(FeaturesRequest):
    """Which objects of a map."""

    kind: Annotated[ObjectKind | None, Field(description="by what is known of both places")] = None
    status: Annotated[ObjectStatus | None, Field(description="as of the latest survey")] = None
    last_known: Annotated[
        ObjectStatus | None, Field(description="as of the latest survey that looked there")
    ] = None
    transient: Annotated[
        bool | None, Field(description="true: what comes and goes; false: what does not")
    ] = None
    survey: Annotated[Id | None, Field(description="objects that this survey saw")] = None
    device_id: Annotated[DeviceId | None, Field(description="objects that a survey of this device saw")] = (
        None
    )
    bbox: Bbox = None
    bbox_crs: BboxCrs = None
    datetime: Annotated[
        Annotated[str, readable(span_of)] | None,
        Field(
            description="objects seen first before its end and last after its start: RFC 3339 instant, or interval "
            "with `..` for an open end",
            examples=["2026-03-01T00:00:00Z/.."],
        ),
    ] = None
    min_probability: MinProbability = None
    sortby: Annotated[
        ObjectSort,
        Field(description="with a minus downwards; left out: those first that were first seen last"),
    ] = "-first_seen"
    limit: Limit = 100
    cursor: Cursor = None
    after: After = None


@router.get(
    "/surveys/{survey_id}/objects",
    summary="The objects that a survey found changed",
    response_class=FeatureResponse,
    response_model=None,
    responses={
        **features.documented(SightingCollection, FgSightingCollection),
        **documented("not_found", "not_ready", "failed", "invalid_request", "bad_request"),
    },
)
def get_survey_objects(
    request: HttpRequest,
    services: Provided,
    survey_id: Annotated[Id, Path()],
    asked: Annotated[SightingsRequest, Query()],
) -> Response:
    """Things that appeared, disappeared or moved, by their number in the coloured cloud.

    A survey of a model that tells tiles alone has none to tell, nor has one whose placement is in doubt, which is not
    the same as none found: that is a 404.
    """
    catalog = services.catalog
    survey = catalog.surveys.ready(survey_id)
    if survey.objects is None:
        raise NotFound(_why_none(survey))
    anchor = catalog.maps.summary(survey.map_id).anchor
    form = form_of(request, asked, anchor)
    wanted = SightingFilter(
        survey_id=survey_id,
        kind=asked.kind,
        bounds=bounds_of(asked.bbox, asked.bbox_crs, anchor),
        min_probability=asked.min_probability,
    )
    after = decoded_values(asked.cursor, asked.sortby, sighting_order(asked.sortby), wanted)
    page = catalog.objects.of_survey(wanted, sort=asked.sortby, after=after, limit=asked.limit)
    return collection_response(
        request,
        form,
        SIGHTINGS,
        [_sighting(one, form) for one in page.items],
        matched=page.matched,
        cursor=encoded_values(asked.sortby, page.following, wanted),
        links=[link(request, f"/surveys/{survey_id}", "survey")],
    )


def _why_none(survey: SurveyRecord) -> str:
    """Say why a survey tells no objects."""
    in_doubt = survey.placement is not None and survey.placement.state == "in_doubt"
    why = "its placement is in doubt" if in_doubt else f"{survey.model} tells tiles alone"
    return f"survey {survey.survey_id!r} tells no objects, for {why}; GET /surveys/{survey.survey_id}/tiles has those"


@router.get(
    "/maps/{map_id}/objects",
    summary="The changed objects of a map over time",
    response_class=FeatureResponse,
    response_model=None,
    responses={
        **features.documented(ObjectCollection, FgObjectCollection),
        **documented("not_found", "not_ready", "failed", "gone", "invalid_request", "bad_request"),
    },
)
def get_objects(
    request: HttpRequest,
    services: Provided,
    map_id: Annotated[Id, Path()],
    asked: Annotated[ObjectsRequest, Query()],
) -> Response:
    """Each changed thing once, with what became of it: those first that were first seen last.

    A thing keeps its id from survey to survey. What a version of the map has taken over stays in the list as `accepted`.

    With `after` those that were published since an earlier answer, in the order of publication: each once, whatever the
    order in which surveys come in, and again with `updated` where something of it changed.
    """
    anchor = services.catalog.maps.ready(map_id).anchor
    form = form_of(request, asked, anchor)
    wanted, of_map = _filter(map_id, asked, anchor), link(request, f"/maps/{map_id}", "map")
    if asked.after is not None:
        require_alone(after=asked.after, cursor=asked.cursor, sortby="sortby" in asked.model_fields_set)
        feed = services.catalog.objects.published(
            wanted, after=FeedCursor.read(asked.after), limit=asked.limit
        )
        return feed_response(request, form, OBJECTS, feed, _object, links=[of_map])
    order = object_order(asked.sortby)
    after = decoded_values(asked.cursor, asked.sortby, [key.type for key in order], wanted)
    page = services.catalog.objects.page(wanted, sort=asked.sortby, after=after, limit=asked.limit)
    return collection_response(
        request,
        form,
        OBJECTS,
        [_object(one, form) for one in page.items],
        matched=page.matched,
        cursor=encoded_values(asked.sortby, page.following, wanted),
        links=[of_map],
    )


@router.get(
    "/maps/{map_id}/objects/{object_id}",
    summary="One object with its history",
    response_class=FeatureResponse,
    response_model=None,
    responses=features.documented(ObjectHistory, FgObjectHistory)
    | MADE
    | documented("bad_request", "invalid_request"),
)
def get_object(
    request: HttpRequest,
    services: Provided,
    map_id: Annotated[Id, Path()],
    object_id: Annotated[Id, Path()],
    asked: Annotated[FeaturesRequest, Query()],
) -> Response:
    """What became of it, and each sighting of it: where it was then, and what spoke for it."""
    form = form_of(request, asked, services.catalog.maps.ready(map_id).anchor)
    record, seen = services.catalog.objects.get(map_id, object_id)
    return feature_response(
        request,
        form,
        OBJECTS,
        _object(record, form),
        more={"sightings": [_sighting(one, form) for one in seen]},
        links=[link(request, f"/maps/{map_id}", "map")],
    )


def _filter(map_id: str, asked: ObjectsRequest, anchor: Anchor | None) -> ObjectFilter:
    """Return which objects are asked for, of a map that lies at `anchor`. Raises BadRequest."""
    since, until = (None, None) if asked.datetime is None else span_of(asked.datetime)
    return ObjectFilter(
        map_id=map_id,
        kind=asked.kind,
        status=asked.status,
        last_known=asked.last_known,
        transient=asked.transient,
        survey_id=asked.survey,
        device_id=asked.device_id,
        bounds=bounds_of(asked.bbox, asked.bbox_crs, anchor),
        since=since,
        until=until,
        min_probability=asked.min_probability,
    )


def _sighting(record: SightingRecord, form: Form) -> dict[str, Any]:
    """Return a sighting, in JSON-FG with the geometry that `form` has."""
    thing = record.thing.model_dump()
    return sighting_feature(thing, survey=_shared(record), geometry=form.geometry(*ring_of(thing)))


def _object(record: MapObjectRecord, form: Form) -> dict[str, Any]:
    """Return an object as it stands, likewise."""
    thing = record.latest.thing.model_dump()
    history = _shared(record.latest) | plain(record.model_dump(exclude={"latest"}))
    return object_feature(thing, history=history, geometry=form.geometry(*ring_of(thing)))


def _shared(record: SightingRecord) -> dict[str, Any]:
    return plain(record.model_dump(exclude={"thing"}))
