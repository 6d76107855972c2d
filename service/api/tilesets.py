"""Clouds as 3D Tiles 1.1 (OGC 22-025r4), of maps, their versions and large surveys: `tileset.json` and its contents.

A version's tileset is in the map's frame, and what lies under the address of a content never changes. That of a map is
a document of one tile, which names the tileset of the version in use, and which may put it on the Earth.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field

from service.api.gis.geodesy import ecef_from_map
from service.api.http.answering import files
from service.api.http.answering.files import blob_response, content_response
from service.api.http.answering.problems import MADE
from service.api.http.dependencies import Provided
from service.api.http.reading import bodies
from service.api.http.reading.fields import Id
from service.catalog.files import blob_keys
from service.catalog.files.tilesets import ContentName
from service.catalog.records import Anchor, Bounds, MapSummary, Tileset
from service.catalog.versions import tileset_of
from service.errors import NotFound
from service.tile_features import MAP_FRAME

router = APIRouter(tags=["tilesets"])
MapId = Annotated[Id, Path()]
SurveyId = Annotated[Id, Path()]
Number = Annotated[int, Path(ge=1, lt=1 << 31, examples=[1])]
Content = Annotated[
    str,
    Path(
        max_length=200,
        description="as `tileset.json` names it: of which tileset, where it begins in the file of all contents, its bytes",
        examples=["5f0c91b64f2e7a08-0-394208.glb"],
    ),
]

GLB = "model/gltf-binary"
_PAD = 1e-4  #: of the box of a cloud: contents are quantised, and their boxes are wider by that


class PlacedRequest(BaseModel):
    """Where the tileset shall lie. What a map's tileset names takes it too: CesiumJS hands it on to all that it loads."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    crs: Annotated[
        Literal[
            "map",
            "EPSG:4978",
            "http://www.opengis.net/def/crs/OGC/0/Engineering3D",
            "http://www.opengis.net/def/crs/EPSG/0/4978",
        ],
        Field(
            description="`map`: metres in the map's own frame; `EPSG:4978`: Earth-centred, by the map's anchor, as globes "
            "want it; also by their URIs"
        ),
    ] = "map"


_DOCUMENT = {200: {"description": "tileset.json (OGC 22-025r4, Section 7)"}, **MADE}
_CONTENT = files.documented(GLB, "Points of one tile, GLB") | MADE


@router.get(
    "/maps/{map_id}/tileset.json",
    summary="The tileset of a map",
    response_model=dict[str, Any],
    responses=_DOCUMENT,
)
async def get_map_tileset(
    services: Provided, map_id: MapId, asked: Annotated[PlacedRequest, Query()]
) -> Response:
    """3D Tiles 1.1 of the fused reference map: one tile, whose content is the tileset of the version in use.

    Readers begin with few points and load what the eye can tell apart. In metres of the map's frame, z up; where the map
    has an anchor, `crs=EPSG:4978` puts it on the Earth.
    """
    ready = await run_in_threadpool(services.catalog.maps.ready, map_id)
    tileset_of(ready.tileset, f"version {ready.version} of map {map_id!r}")
    document = _of_version_in_use(ready, on_earth=asked.crs not in ("map", MAP_FRAME))
    return JSONResponse(document, headers={"Cache-Control": files.REVALIDATED})


@router.get(
    "/maps/{map_id}/versions/{number}/tileset.json",
    summary="The tileset of a version of a map",
    response_model=dict[str, Any],
    responses=_DOCUMENT,
)
async def get_version_tileset(
    services: Provided, map_id: MapId, number: Number, _handed_on: Annotated[PlacedRequest, Query()]
) -> Response:
    """3D Tiles 1.1 of the version's fused cloud, in metres of the map's frame, z up; each point is in one content."""
    job_id, _ = await run_in_threadpool(services.catalog.versions.tileset, map_id, number)
    key = blob_keys.map_tileset(job_id)
    return await blob_response(services.catalog.blobs, key, media_type=bodies.JSON, asked_again=True)


@router.get(
    "/maps/{map_id}/versions/{number}/tileset/{content}",
    summary="A content of a version's tileset",
    response_class=Response,
    responses=_CONTENT,
)
async def get_version_tileset_content(
    services: Provided,
    map_id: MapId,
    number: Number,
    content: Content,
    _handed_on: Annotated[PlacedRequest, Query()],
) -> Response:
    """Points as GLB: quantised positions (KHR_mesh_quantization), with colours or normals."""
    job_id, tileset = await run_in_threadpool(services.catalog.versions.tileset, map_id, number)
    name, key = _named(content, tileset), blob_keys.map_tileset_contents(job_id)
    return await content_response(services.catalog.blobs, key, name, media_type=GLB)


@router.get(
    "/surveys/{survey_id}/tileset.json",
    summary="The tileset of a survey",
    response_model=dict[str, Any],
    responses=_DOCUMENT,
)
async def get_survey_tileset(services: Provided, survey_id: SurveyId) -> Response:
    """3D Tiles 1.1 of the coloured cloud of a survey that is too large to be read whole (a million points)."""
    await run_in_threadpool(services.catalog.surveys.tileset, survey_id)
    key = blob_keys.survey_tileset(survey_id)
    return await blob_response(services.catalog.blobs, key, media_type=bodies.JSON, immutable=True)


@router.get(
    "/surveys/{survey_id}/tileset/{content}",
    summary="A content of a survey's tileset",
    response_class=Response,
    responses=_CONTENT,
)
async def get_survey_tileset_content(services: Provided, survey_id: SurveyId, content: Content) -> Response:
    """Points as GLB: quantised positions (KHR_mesh_quantization), with the colours of `cloud.ply`."""
    tileset = await run_in_threadpool(services.catalog.surveys.tileset, survey_id)
    name, key = _named(content, tileset), blob_keys.survey_tileset_contents(survey_id)
    return await content_response(services.catalog.blobs, key, name, media_type=GLB)


def _named(content: str, tileset: Tileset) -> ContentName:
    """Read the name of a content. Raises NotFound for one of another tileset, or none."""
    name = ContentName.of(content)
    if name is None or not name.is_of(tileset.sha256):
        raise NotFound(f"no content {content[:100]!r}; tileset.json names those there are")
    return name


def _of_version_in_use(ready: MapSummary, *, on_earth: bool) -> dict[str, Any]:
    """Return the tileset of one tile that names the version's. Raises RequestValidationError without an anchor."""
    if ready.bounds is None:
        raise NotFound(f"map {ready.map_id!r} has no extent")
    box, widest = _box(ready.bounds)
    root: dict[str, Any] = {
        "boundingVolume": {"box": box},
        "geometricError": widest,
        "refine": "ADD",
        "content": {"uri": f"versions/{ready.version}/tileset.json"},
    }
    if on_earth:
        root["transform"] = ecef_from_map(_anchored(ready))
    return {
        "asset": {"version": "1.1", "generator": "SPICD"},
        "geometricError": widest,
        "root": root,
    }


def _anchored(ready: MapSummary) -> Anchor:
    if ready.anchor is None:
        raise RequestValidationError(
            [
                {
                    "type": "no_anchor",
                    "loc": ("query", "crs"),
                    "msg": "nobody said where this map lies on the Earth; ask with crs=map, or put an anchor",
                    "input": "EPSG:4978",
                }
            ]
        )
    return ready.anchor


def _box(bounds: Bounds) -> tuple[list[float], float]:
    """Return middle and half axes of the box, and its longest side, metres."""
    sides = [high - low for low, high in zip(bounds.min, bounds.max, strict=True)]
    widest = max(sides)
    x, y, z = (side / 2 + _PAD * (widest + 1) for side in sides)
    middle = [(low + high) / 2 for low, high in zip(bounds.min, bounds.max, strict=True)]
    return [*middle, x, 0, 0, 0, y, 0, 0, 0, z], widest
