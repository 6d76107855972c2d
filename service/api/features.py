"""Tiles as documents of the API: `service.tile_features` with a footprint on the Earth, and their schema.

The footprint lies at the height of the tile's floor where the map has a geo-anchor, and is null without one. Answers
are written as they are built, 10,000 tiles at a time; a test holds them against the models of the schema.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any, Literal

from fastapi.responses import Response
from pydantic import Field
from pydantic_core import to_json

from service.api.feeds import FEED_CURSOR, FEED_WITHDRAWN, WithdrawnDocument
from service.api.geodesy import ToWgs84, to_wgs84
from service.api.http.documents import Document, Link
from service.catalog.records import Anchor, ChangeRecord, TileState, Vector3, rfc3339
from service.catalog.tables import now
from service.tile_features import (
    CONFORMS_TO,
    FEATURE_TYPE,
    MAP_FRAME,
    Ring,
    footprint,
    tile_collection,
    tile_feature,
)

MEDIA_TYPE = "application/geo+json"

Position2 = tuple[float, float]


class Polygon(Document):
    """The footprint, counter-clockwise and closed."""

    type: Literal["Polygon"] = "Polygon"
    coordinates: tuple[tuple[Position2, ...]] = Field(
        examples=[[[[6.0, 3.0], [7.5, 3.0], [7.5, 4.5], [6.0, 4.5], [6.0, 3.0]]]]
    )


class Footprint(Document):
    """The footprint on the Earth: longitude, latitude (degrees), height of the tile's floor above the ellipsoid (metres).

    Counter-clockwise and closed (RFC 7946, Section 3.1.6).
    """

    type: Literal["Polygon"] = "Polygon"
    coordinates: tuple[tuple[Vector3, ...]]


class Prism(Document):
    """A box over its footprint, metres, map frame."""

    type: Literal["Prism"] = "Prism"
    base: Polygon
    lower: float = Field(examples=[0.0])
    upper: float = Field(examples=[1.0])


class Time(Document):
    """When the visit was."""

    timestamp: str = Field(examples=["2026-03-01T12:00:00Z"])


class TileProperties(Document):
    """What is said of a tile."""

    tile_id: str = Field(examples=["tile_004_002_000"])
    tile_index: tuple[int, int, int] = Field(examples=[[4, 2, 0]])
    center: Vector3 = Field(description="metres, map frame", examples=[[6.75, 3.75, 0.5]])
    state: TileState = Field(
        description="`unobserved`: the visit could not judge enough of it; `inconsistent`: no change is proved, but the "
        "registration there is in doubt; so is every observed tile of a survey whose placement is in doubt",
        examples=["changed"],
    )
    score: float | None = Field(
        description="probability of change; null where nothing could be compared", examples=[0.93]
    )
    probabilities: Vector3 | None = Field(
        description="unchanged, changed, different place", examples=[[0.05, 0.93, 0.02]]
    )
    threshold: float | None = Field(description="changed above this score", examples=[0.5])
    n_reference: int = Field(description="points of the map in the tile", examples=[1904])
    n_current: int = Field(description="points of the survey in the tile", examples=[2210])
    observed_share: float | None = Field(
        description="of the tile, that the survey could judge; null of models that tell tiles alone, like the next two",
        examples=[0.87],
    )
    appeared: int | None = Field(description="voxels with something new", examples=[212])
    disappeared: int | None = Field(description="voxels with something gone", examples=[0])
    map_id: str = Field(examples=["lobby"])
    map_version: int = Field(description="that the survey was compared with", examples=[1])
    survey_id: str = Field(examples=["survey-91c4"])
    model: str = Field(examples=["voxel-net/1"])
    captured_at: str = Field(examples=["2026-03-01T12:00:00Z"])
    first_seen: str | None = Field(
        description="by a visit that saw this change of the tile; null where it is not changed",
        examples=["2026-03-01T12:00:00Z"],
    )
    last_seen: str | None = Field(
        description="likewise, before it was gone again or taken over", examples=["2026-03-08T12:00:00Z"]
    )
    max_score: float | None = Field(description="over those visits", examples=[0.97])
    change_id: str | None = Field(
        None,
        description="of the change, the same for as long as it is told; null where the tile is not changed",
        examples=["change-5c02"],
    )


class TileFeature(Document):
    """One tile."""

    type: Literal["Feature"] = "Feature"
    id: str = Field(examples=["survey-91c4.tile_004_002_000"])
    geometry: Footprint | None = Field(description="WGS 84; null where the map has no geo-anchor")
    place: Prism
    time: Time
    properties: TileProperties


class TileCollection(Document):
    """Tiles; the members that hold for all stand on the root, as the standard has it."""

    type: Literal["FeatureCollection"] = "FeatureCollection"
    conformsTo: tuple[str, ...] = CONFORMS_TO  # noqa: N815 - the standard's name
    featureType: str = FEATURE_TYPE  # noqa: N815
    coordRefSys: str = MAP_FRAME  # noqa: N815
    timeStamp: str = Field(examples=["2026-03-01T12:05:00Z"])  # noqa: N815
    numberMatched: int = Field(examples=[1])  # noqa: N815
    numberReturned: int = Field(examples=[1])  # noqa: N815
    links: list[Link]
    features: list[TileFeature]
    cursor: str | None = FEED_CURSOR
    withdrawn: list[WithdrawnDocument] | None = FEED_WITHDRAWN


class FeatureResponse(Response):
    """Features."""

    media_type = MEDIA_TYPE


def feature_response(
    changes: Iterable[ChangeRecord],
    *,
    matched: int,
    links: Iterable[Link],
    anchor: Anchor | None,
    members: Mapping[str, Any] | None = None,
) -> FeatureResponse:
    """Answer with tiles of a map that lies at `anchor`; `matched` counts those of every page, `members` stand beside."""
    convert = None if anchor is None else to_wgs84(anchor)
    collection = tile_collection((feature(change, convert) for change in changes), matched=matched)
    collection |= {"timeStamp": rfc3339(now()), "links": list(links), **(members or {})}
    return FeatureResponse(to_json(collection, inf_nan_mode="null"))


def feature(change: ChangeRecord, convert: ToWgs84 | None) -> dict[str, Any]:
    """Return one tile of a survey; `convert` takes points of the map frame to the Earth."""
    tile, (lower, upper) = change.tile, (change.tile.bounds.min, change.tile.bounds.max)
    survey = plain(change.model_dump(exclude={"tile"}))
    geometry = None if convert is None else on_earth(footprint(lower, upper), lower[2], convert)
    return tile_feature(
        **tile.model_dump(exclude={"bounds"}), lower=lower, upper=upper, survey=survey, geometry=geometry
    )


def on_earth(ring: Ring, lower: float, convert: ToWgs84) -> dict[str, Any]:
    """Return a ring at the height `lower` in WGS 84, to about a millimetre: 9 decimals of a degree are 0.1 mm."""
    corners = (convert((x, y, lower)) for x, y in ring)
    coordinates = [[round(lon, 9), round(lat, 9), round(height, 3)] for lon, lat, height in corners]
    return {"type": "Polygon", "coordinates": [coordinates]}


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same values with instants written out (RFC 3339)."""
    return {name: rfc3339(value) if isinstance(value, datetime) else value for name, value in values.items()}


def documented(answer: type[Document] = TileCollection) -> dict[int | str, dict[str, Any]]:
    """Return the 200 of a route that answers with features, for the generated API description."""
    schema = {"$ref": f"#/components/schemas/{answer.__name__}"}
    description = "A JSON-FG FeatureCollection" if "features" in answer.model_fields else "A JSON-FG Feature"
    return {200: {"description": description, "content": {MEDIA_TYPE: {"schema": schema}}}}
