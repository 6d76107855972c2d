"""Features as answers: in which form (GeoJSON, JSON-FG, CSV), in which frame, with which links and headers.

Plain GeoJSON is what a client gets that asks for nothing else, JSON-FG on request: the profiles "rfc7946" and "jsonfg"
of JSON-FG 1.0 (OGC 21-045r1, Clauses 14 and 15). The footprint lies at the height of the floor of what it is of.
Answers are written as they are built, 10,000 features at a time; a test holds them against the models of the schema.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import Request as HttpRequest
from fastapi.responses import Response, StreamingResponse
from pydantic import Field
from pydantic_core import to_json

from service.api.gis.boxes import CRS84H, Crs, is_map_frame
from service.api.gis.geodesy import ToWgs84, to_wgs84
from service.api.http.answering.documents import Document, Link, Request
from service.api.http.answering.negotiation import preferred
from service.api.http.answering.paging import next_link
from service.api.http.answering.problems import documented as problems
from service.catalog.records import Anchor, Vector3, rfc3339
from service.catalog.sql.tables import now
from service.errors import BadRequest
from service.tile_features import (
    CONFORMS_TO,
    MAP_FRAME,
    MAP_FRAME_WKT,
    Ring,
    feature_collection,
    geojson_collection,
    geojson_feature,
    local_footprint,
    map_frame_member,
)

MEDIA_TYPE = "application/geo+json"
#: JSON-FG 1.0 is `application/geo+json` too (Clause 16), which tells no profile from another; this name, of its drafts,
#: is permitted, and what GeoServer and ldproxy answer with.
JSON_FG = "application/vnd.ogc.fg+json"
CSV = "text/csv"
_JSON = "application/json"  #: accepted, and answered with GeoJSON
_PROFILE = "http://www.opengis.net/def/profile/OGC/0/{}"
_PIECE = 500  #: rows of CSV that are sent at a time
_FORMULA = (
    "=",
    "+",
    "-",
    "@",
    "\t",
    "\r",
    "\n",
)  #: what a spreadsheet takes for the start of a formula (OWASP)

Position2 = tuple[float, float]


class FeaturesRequest(Request):
    """In which form and frame features are asked for."""

    f: Annotated[
        Literal["json", "csv"] | None,
        Field(description="the form, before what `Accept` says: GeoJSON or a table (RFC 4180)"),
    ] = None
    profile: Annotated[
        Literal["rfc7946", "jsonfg"] | None,
        Field(
            description="of GeoJSON: plain (the default), or JSON-FG 1.0, in which `place` is a prism in the map's frame"
        ),
    ] = None
    crs: Annotated[
        Crs | None,
        Field(
            description="of `geometry` in plain GeoJSON and of `WKT` in tables: WGS 84 (the default), which is null on a "
            "map without an anchor, or `map`, metres in the map's frame",
            examples=["map"],
        ),
    ] = None


class Polygon(Document):
    """The footprint, counter-clockwise and closed."""

    type: Literal["Polygon"] = "Polygon"
    coordinates: tuple[tuple[Position2, ...]] = Field(
        examples=[[[[6.0, 3.0], [7.5, 3.0], [7.5, 4.5], [6.0, 4.5], [6.0, 3.0]]]]
    )


class Footprint(Document):
    """The footprint on the Earth: longitude, latitude (degrees), height of the floor above the ellipsoid (metres).

    Counter-clockwise and closed (RFC 7946, Section 3.1.6). With `crs=map` it is x, y, z in the map's frame, metres.
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


class CrsName(Document):
    """The map's frame as GDAL, GeoPandas and QGIS read it (WKT 2)."""

    name: str = Field(examples=[MAP_FRAME_WKT])


class NamedCrs(Document):
    """The frame of the coordinates where that is not WGS 84 (the GeoJSON of 2008, Section 3)."""

    type: Literal["name"] = "name"
    properties: CrsName


class GeoJsonFeature(Document):
    """What features have in common in plain GeoJSON."""

    type: Literal["Feature"] = "Feature"
    id: str
    geometry: Footprint | None = Field(
        description="WGS 84, null where the map has no geo-anchor; with `crs=map` in the map's frame"
    )


class GeoJsonCollection(Document):
    """What collections have in common in plain GeoJSON."""

    type: Literal["FeatureCollection"] = "FeatureCollection"
    crs: NamedCrs | None = Field(None, description="with `crs=map` alone")
    timeStamp: str = Field(examples=["2026-03-01T12:05:00Z"])  # noqa: N815 - the standard's name
    numberMatched: int = Field(examples=[1])  # noqa: N815
    numberReturned: int = Field(examples=[1])  # noqa: N815
    links: list[Link]


class FgCollection(Document):
    """What collections have in common in JSON-FG: what holds for all stands on the root, as the standard has it."""

    type: Literal["FeatureCollection"] = "FeatureCollection"
    conformsTo: tuple[str, ...] = CONFORMS_TO  # noqa: N815 - the standard's name
    featureType: str = Field(  # noqa: N815
        description="`spicd-tile`, or of objects `spicd-object`", examples=["spicd-tile", "spicd-object"]
    )
    coordRefSys: str = MAP_FRAME  # noqa: N815
    timeStamp: str = Field(examples=["2026-03-01T12:05:00Z"])  # noqa: N815
    numberMatched: int = Field(examples=[1])  # noqa: N815
    numberReturned: int = Field(examples=[1])  # noqa: N815
    links: list[Link]


class FeatureResponse(Response):
    """Features; a route says itself of which media types, so that none is documented twice."""

    media_type = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Kind:
    """A sort of features: its name, and the columns that it has in a table."""

    feature_type: str
    columns: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Form:
    """How an answer shows features of one map."""

    media_type: str
    in_map_frame: bool  #: `geometry`, where the profile is plain GeoJSON
    convert: ToWgs84 | None  #: None where nobody said where the map lies

    @property
    def crs(self) -> str | None:
        """The URI of the frame that coordinates are in; None where there are none."""
        if self.in_map_frame or self.media_type == JSON_FG:
            return MAP_FRAME
        return None if self.convert is None else CRS84H

    def geometry(self, ring: Ring, lower: float) -> dict[str, Any] | None:
        """Return the footprint with this closed outline and this lower height (metres, map frame)."""
        if self.in_map_frame and self.media_type != JSON_FG:
            return local_footprint(ring, lower)
        return None if self.convert is None else on_earth(ring, lower, self.convert)


def form_of(request: HttpRequest, asked: FeaturesRequest, anchor: Anchor | None) -> Form:
    """Return the form that a request asks for, of features of a map that lies at `anchor`.

    `f` and `profile` go before `Accept`. Raises NotAcceptable, and BadRequest for a profile of a table.
    """
    if asked.f == "csv" and asked.profile is not None:
        raise BadRequest(f"profile={asked.profile} is one of GeoJSON; leave it out with f=csv")
    if asked.f is None and asked.profile is None:
        chosen = preferred(request, (MEDIA_TYPE, _JSON, JSON_FG, CSV))
    else:
        chosen = CSV if asked.f == "csv" else JSON_FG if asked.profile == "jsonfg" else MEDIA_TYPE
    return Form(
        media_type=MEDIA_TYPE if chosen == _JSON else chosen,
        in_map_frame=is_map_frame(asked.crs),
        convert=None if anchor is None else to_wgs84(anchor),
    )


def collection_response(
    request: HttpRequest,
    form: Form,
    kind: Kind,
    features: Sequence[Mapping[str, Any]],
    *,
    matched: int,
    cursor: str | None = None,
    following: Link | None = None,
    links: Iterable[Link] = (),
    members: Mapping[str, Any] | None = None,
) -> Response:
    """Answer with features, JSON-FG ones as `service.tile_features` makes them; `matched` counts those of every page.

    `cursor` is that of the next page; or `following` leads there. `members` stand beside the features. How many there
    are, and where to go on, stands in headers too, for a table has no other place for it.
    """
    if cursor is not None:
        following = next_link(request, cursor, form.media_type)
    further = [] if following is None else [following]
    headers = _headers(form, further)
    headers |= {"OGC-NumberMatched": str(matched), "OGC-NumberReturned": str(len(features))}
    if form.media_type == CSV:
        return _table(kind, features, headers)
    if form.media_type == JSON_FG:
        collection = feature_collection((dict(one) for one in features), kind.feature_type, matched=matched)
    else:
        collection = geojson_collection(features, matched=matched, in_map_frame=form.in_map_frame)
    collection |= {"timeStamp": rfc3339(now()), "links": [*_about(request, form), *further, *links]}
    collection |= members or {}
    return _json_response(collection, form, headers)


def feature_response(
    request: HttpRequest,
    form: Form,
    kind: Kind,
    feature: Mapping[str, Any],
    *,
    more: Mapping[str, Sequence[Mapping[str, Any]]],
    links: Iterable[Link],
) -> Response:
    """Answer with one feature; `more` holds its further members, lists of features. A table has a row of it alone."""
    headers = _headers(form, ())
    if form.media_type == CSV:
        return _table(kind, [feature], headers)
    document: dict[str, Any]
    if form.media_type == JSON_FG:
        document = {**feature, **more}
    else:
        document = geojson_feature(feature) | (map_frame_member() if form.in_map_frame else {})
        document |= {name: [geojson_feature(one) for one in members] for name, members in more.items()}
    return _json_response(document | {"links": [*_about(request, form), *links]}, form, headers)


def _json_response(document: Mapping[str, Any], form: Form, headers: Mapping[str, str]) -> Response:
    return FeatureResponse(
        to_json(document, inf_nan_mode="null"), headers={**headers, "Content-Type": form.media_type}
    )


def _about(request: HttpRequest, form: Form) -> list[Link]:
    """Return the links of an answer to itself, to its profile and to its other forms."""
    here = request.url.replace(scheme="", netloc="").remove_query_params(("f", "profile"))
    others = {
        MEDIA_TYPE: here,
        JSON_FG: here.include_query_params(profile="jsonfg"),
        CSV: here.include_query_params(f="csv"),
    }
    links = [
        Link(href=str(request.url.replace(scheme="", netloc="")), rel="self", type=form.media_type),
        Link(href=_profile_of(form), rel="profile", type="text/html"),
    ]
    return links + [
        Link(href=str(href), rel="alternate", type=media_type)
        for media_type, href in others.items()
        if media_type != form.media_type
    ]


def _profile_of(form: Form) -> str:
    """Return the URI of the profile that an answer follows."""
    return _PROFILE.format("jsonfg" if form.media_type == JSON_FG else "rfc7946")


def _headers(form: Form, following: Sequence[Link]) -> dict[str, str]:
    """Return the headers that tell profile, frame and next page (RFC 8288, RFC 6906; OGC 18-058r1, Section 6.4)."""
    links = [f'<{link.href}>; rel="{link.rel}"; type="{link.type}"' for link in following]
    if form.media_type != CSV:
        links.append(f'<{_profile_of(form)}>; rel="profile"')
    headers = {"Vary": "Accept"}
    if links:
        headers["Link"] = ", ".join(links)
    if form.crs is not None:
        headers["Content-Crs"] = f"<{form.crs}>"
    return headers


def _table(kind: Kind, features: Sequence[Mapping[str, Any]], headers: Mapping[str, str]) -> Response:
    """Answer with a table: a header row, and a row for each feature (RFC 4180)."""
    return StreamingResponse(
        _rows(kind, features), media_type=f"{CSV}; header=present", headers=dict(headers)
    )


def _rows(kind: Kind, features: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(("id", *kind.columns, "WKT"))
    for number, feature in enumerate(features, start=1):
        properties = feature["properties"]
        shown = (_cell(properties.get(name)) for name in kind.columns)
        writer.writerow((_cell(feature["id"]), *shown, _wkt(feature["geometry"])))
        if number % _PIECE == 0:
            yield text.getvalue()
            text.seek(0)
            text.truncate()
    yield text.getvalue()


def _cell(value: str | float | bool | None) -> str:
    """Write a value; a text that a spreadsheet would take for a formula begins with an apostrophe."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"'{value}" if value.startswith(_FORMULA) else value
    return repr(value)


def _wkt(geometry: Mapping[str, Any] | None) -> str:
    """Write a footprint as well-known text (OGC 06-103r4); nothing where there is none."""
    if geometry is None:
        return ""
    (ring,) = geometry["coordinates"]
    return f"POLYGON Z (({', '.join(' '.join(map(repr, corner)) for corner in ring)}))"


def on_earth(ring: Ring, lower: float, convert: ToWgs84) -> dict[str, Any]:
    """Return a ring at the height `lower` in WGS 84, to about a millimetre: 9 decimals of a degree are 0.1 mm."""
    corners = (convert((x, y, lower)) for x, y in ring)
    coordinates = [[round(lon, 9), round(lat, 9), round(height, 3)] for lon, lat, height in corners]
    return {"type": "Polygon", "coordinates": [coordinates]}


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same values with instants written out (RFC 3339)."""
    return {name: rfc3339(value) if isinstance(value, datetime) else value for name, value in values.items()}


def documented(geojson: type[Document], json_fg: type[Document]) -> dict[int | str, dict[str, Any]]:
    """Return the 200 and the 406 of a route that answers with features, for the generated API description."""
    what = "FeatureCollection" if "features" in geojson.model_fields else "Feature"
    schemas: dict[str, dict[str, Any]] = {
        media_type: {"$ref": f"#/components/schemas/{model.__name__}"}
        for media_type, model in ((MEDIA_TYPE, geojson), (JSON_FG, json_fg))
    }
    schemas[CSV] = {"type": "string"}
    content = {media_type: {"schema": schema} for media_type, schema in schemas.items()}
    description = f"A {what}: GeoJSON, JSON-FG or a table"
    return {200: {"description": description, "content": content}, **problems("not_acceptable")}
