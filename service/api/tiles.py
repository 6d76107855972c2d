"""/surveys/{id}/tiles: every tile of a survey; and tiles as documents, which changes are as well."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from fastapi import Request as HttpRequest
from fastapi.responses import Response
from pydantic import Field

from service.api.gis.boxes import Crs, bounds_of, numbers_of
from service.api.gis.features import (
    FeatureResponse,
    FeaturesRequest,
    FgCollection,
    Form,
    GeoJsonCollection,
    GeoJsonFeature,
    Kind,
    Prism,
    Time,
    collection_response,
    documented,
    form_of,
    plain,
)
from service.api.gis.feeds import FEED_CURSOR, FEED_UPDATED, FEED_WITHDRAWN, WithdrawnDocument
from service.api.http.answering.documents import Document, link
from service.api.http.answering.paging import Cursor, decoded_values, encoded_values
from service.api.http.answering.problems import documented as problems
from service.api.http.dependencies import Provided
from service.api.http.reading.fields import Id, readable
from service.catalog.findings.changes import TileFilter, TileSort, VoxelKind, tile_order
from service.catalog.records import ChangeRecord, TileState, Vector3
from service.tile_features import FEATURE_TYPE, footprint, tile_feature

router = APIRouter(tags=["surveys"])

MinScore = Annotated[float | None, Field(ge=0, le=1, description="probability of change")]
Bbox = Annotated[
    Annotated[str, readable(numbers_of)] | None,
    Field(
        description="what meets this box: four numbers with commas between, min x, min y, max x, max y, or six, min x, min "
        "y, min z, max x, max y, max z, in the frame that `bbox-crs` names (on the Earth x is the longitude, y the latitude)",
        examples=["0,0,7.5,4.5"],
    ),
]
BboxCrs = Annotated[
    Crs | None,
    Field(
        alias="bbox-crs",
        description="of `bbox`: `CRS84` (longitude, latitude; the default where the map has an anchor), `CRS84h` (and "
        "height above the ellipsoid), or `map` (metres in the map's frame; the default where it has none). A box on the "
        "Earth takes in somewhat more where the map is turned against the meridian",
        examples=["map"],
    ),
]
VoxelKinds = Annotated[
    VoxelKind | None,
    Field(
        description="tiles with voxels that did so; none of models that tell tiles alone. What `moved` is told of objects, "
        "not of tiles"
    ),
]


class TileProperties(Document):
    """What is said of a tile."""

    tile_id: str = Field(examples=["tile_004_002_000"])
    tile_index: tuple[int, int, int] = Field(examples=[[4, 2, 0]])
    center: Vector3 = Field(description="metres, map frame", examples=[[6.75, 3.75, 0.5]])
    center_x: float = Field(description="the same in numbers of their own", examples=[6.75])
    center_y: float = Field(examples=[3.75])
    z_min: float = Field(description="metres, map frame", examples=[0.0])
    z_max: float = Field(description="likewise", examples=[1.0])
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
    p_unchanged: float | None = Field(description="the same in numbers of their own", examples=[0.05])
    p_changed: float | None = Field(examples=[0.93])
    p_different: float | None = Field(examples=[0.02])
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
    device_id: str | None = Field(description="of the survey", examples=["robot-7"])
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
        description="of the change, the same for as long as it is told; null where the tile is not changed",
        examples=["change-5c02"],
    )
    updated: bool | None = FEED_UPDATED


class TileFeature(GeoJsonFeature):
    """One tile."""

    id: str = Field(
        description="of the tile in its survey; of a change that is told once that of the change, as in `withdrawn`",
        examples=["survey-91c4.tile_004_002_000"],
    )
    properties: TileProperties


class FgTileFeature(TileFeature):
    """One tile in JSON-FG."""

    place: Prism
    time: Time


class TileCollection(GeoJsonCollection):
    """Tiles."""

    features: list[TileFeature]
    cursor: str | None = FEED_CURSOR
    withdrawn: list[WithdrawnDocument] | None = FEED_WITHDRAWN


class FgTileCollection(FgCollection):
    """Tiles in JSON-FG."""

    features: list[FgTileFeature]
    cursor: str | None = FEED_CURSOR
    withdrawn: list[WithdrawnDocument] | None = FEED_WITHDRAWN


_NESTED = {"tile_index", "center", "probabilities"}
TILES = Kind(
    feature_type=FEATURE_TYPE,
    columns=tuple(name for name in TileProperties.model_fields if name not in _NESTED),
)


class TilesRequest(FeaturesRequest):
    """Which tiles of a survey."""

    state: TileState | None = None
    kind: VoxelKinds = None
    min_score: MinScore = None
    bbox: Bbox = None
    bbox_crs: BboxCrs = None
    sortby: Annotated[
        TileSort, Field(description="order of the grid, or by score; with a minus downwards")
    ] = "tile_index"
    limit: Annotated[
        int | None, Field(ge=1, le=10000, description="most features in one answer; left out: all there are")
    ] = None
    cursor: Cursor = None


@router.get(
    "/surveys/{survey_id}/tiles",
    summary="Every tile of a survey",
    response_class=FeatureResponse,
    response_model=None,
    responses={
        **documented(TileCollection, FgTileCollection),
        **problems("not_found", "not_ready", "failed", "invalid_request", "bad_request"),
    },
)
def get_tiles(
    request: HttpRequest,
    services: Provided,
    survey_id: Annotated[Id, Path()],
    asked: Annotated[TilesRequest, Query()],
) -> Response:
    """Unchanged, changed, inconsistent and unobserved tiles alike; all of them where no `limit` is given."""
    survey = services.catalog.surveys.ready(survey_id)
    anchor = services.catalog.maps.summary(survey.map_id).anchor
    form = form_of(request, asked, anchor)
    wanted = TileFilter(
        survey_id=survey_id,
        state=asked.state,
        kind=asked.kind,
        min_score=asked.min_score,
        bounds=bounds_of(asked.bbox, asked.bbox_crs, anchor),
    )
    after = decoded_values(asked.cursor, asked.sortby, [key.type for key in tile_order(asked.sortby)], wanted)
    page = services.catalog.changes.tiles(wanted, sort=asked.sortby, after=after, limit=asked.limit)
    return collection_response(
        request,
        form,
        TILES,
        [feature(change, form) for change in page.items],
        matched=page.matched,
        cursor=encoded_values(asked.sortby, page.following, wanted),
        links=[link(request, f"/surveys/{survey_id}", "survey")],
    )


def feature(change: ChangeRecord, form: Form) -> dict[str, Any]:
    """Return one tile of a survey, in JSON-FG with the geometry that `form` has."""
    tile, (lower, upper) = change.tile, (change.tile.bounds.min, change.tile.bounds.max)
    return tile_feature(
        **tile.model_dump(exclude={"bounds"}),
        lower=lower,
        upper=upper,
        survey=plain(change.model_dump(exclude={"tile"})),
        geometry=form.geometry(footprint(lower, upper), lower[2]),
    )
