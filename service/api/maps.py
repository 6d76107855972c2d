"""/maps: reference maps, built by a job, and where they lie on the Earth."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Response
from fastapi import Request as HttpRequest
from fastapi.concurrency import run_in_threadpool
from pydantic import BeforeValidator, Field

from service.api.http.answering import files
from service.api.http.answering.documents import Document, Link, Request, checked, link
from service.api.http.answering.files import blob_response
from service.api.http.answering.paging import (
    Cursor,
    Limit,
    PageRequest,
    count,
    decoded,
    encoded,
    here,
    list_links,
    next_link,
)
from service.api.http.answering.problems import BODY, LISTED, MADE, NAMED, JobProblem, documented
from service.api.http.dependencies import Provided, Services
from service.api.http.guards.access import maps_of_key, require_map
from service.api.http.reading import bodies
from service.api.http.reading.bodies import Body
from service.api.http.reading.fields import Id, Model, Text, from_text
from service.api.http.reading.idempotency import KEYED, Keyed
from service.api.http.reading.submission import (
    SUBMITTED,
    ScansRequest,
    accepted,
    admit,
    delete,
    job_headers,
    kept_scans,
    lane,
    monitor,
    stop_if_open,
    submit,
)
from service.api.manifests import Manifest
from service.catalog.files import blob_keys
from service.catalog.idempotency import Answer, Once
from service.catalog.records import (
    Anchor,
    Built,
    JobRecord,
    MapRecord,
    MapStatus,
    MapSummary,
    ScanOutcome,
    Tileset,
)
from service.catalog.versions import ScanPosition

router = APIRouter(tags=["maps"])
MapId = Annotated[Id, Path()]
SCANS_SHOWN = 100  #: of a map or a version, in its document
SCANS_LISTED = documented("not_found", "gone", "invalid_request", "bad_request")


class RegistrationRequest(Request):
    """Limits of the registration; what is left out keeps its default (paper, Table 1)."""

    max_correspondence_distance: Annotated[float | None, Field(gt=0, le=1, description="metres")] = None
    min_fitness: Annotated[float | None, Field(ge=0, le=1, description="inlier fraction")] = None
    max_inlier_rmse: Annotated[float | None, Field(gt=0, le=1, description="metres")] = None
    max_iterations: Annotated[int | None, Field(ge=1, le=1000, description="of ICP at each gate")] = None
    min_overlap: Annotated[
        float | None, Field(ge=0, le=1, description="share of the scan that the map covers")
    ] = None
    min_agreement: Annotated[
        float | None, Field(ge=0, le=1, description="share of the overlap on a common surface")
    ] = None


class CarrierRequest(Request):
    """What stands in every scan near the sensor, the robot itself, is cut."""

    radius: Annotated[
        float,
        Field(
            ge=0, le=5, description="metres around the sensor, within which it is looked for; 0 cuts nothing"
        ),
    ]


class PlacementRequest(Request):
    """What it takes for a survey's poses to be believed; what is left out keeps its default."""

    min_confidence: Annotated[
        float | None,
        Field(gt=0, lt=1, description="of a survey's poses; below it the survey is in doubt (0.7)"),
    ] = None
    scale: Annotated[
        Literal["warn", "refuse"] | None,
        Field(
            description="what becomes of a scan whose lengths are off by more than 0.6%; from 1.25% on it is left out"
        ),
    ] = None


class MapSettings(Request):
    """What of a map can be set. Voxel and tile size belong to the model, and so to its card."""

    registration: RegistrationRequest = RegistrationRequest()
    carrier: Annotated[CarrierRequest | None, Field(description="left out: 0.7 m")] = None
    placement: Annotated[
        PlacementRequest | None, Field(description="left out: in doubt under 0.7, a wrong scale is a warning")
    ] = None
    alarms_per_survey: Annotated[
        float,
        Field(
            gt=0,
            description="false objects that a survey of a place without any change may have in the mean; a model that "
            "tells objects turns it into thresholds on the map's own repeated scans",
        ),
    ] = 0.1


class AnchorRequest(Anchor):
    """Where a map lies on the Earth: the origin of its frame in WGS 84, and how the frame is turned; z points up there."""

    longitude: Annotated[float, Field(ge=-180, le=180, description="degrees, of the origin", examples=[13.4])]
    latitude: Annotated[float, Field(ge=-90, le=90, description="degrees, of the origin", examples=[52.5])]
    height: Annotated[
        float,
        Field(ge=-1000, le=10_000, description="metres above the ellipsoid, of the origin", examples=[76.2]),
    ]
    heading: Annotated[
        float,
        Field(
            ge=0,
            lt=360,
            description="degrees, clockwise from true north to the map's x axis; 90: x points east, y north",
            examples=[90],
        ),
    ]


class MapRequest(ScansRequest):
    """A map of scans that were uploaded before, or come with the request."""

    id: Annotated[Id | None, Field(description="left out: the service chooses one")] = None
    name: Annotated[Text | None, Field(max_length=200, examples=["Lobby, ground floor"])] = None
    settings: Annotated[MapSettings, BeforeValidator(from_text)] = MapSettings()
    model: Annotated[Model | None, Field(description="left out: the service's default")] = None
    anchor: Annotated[
        Annotated[AnchorRequest, BeforeValidator(from_text)] | None,
        Field(description="left out: nobody knows where on the Earth it lies"),
    ] = None


class BuiltDocument(Built, Document):
    """What documents of maps and versions have in common."""

    scans: tuple[ScanOutcome, ...] = Field(
        description="the first 100 of its `scan_count` scans: those of the base that were accepted, then the new ones, as "
        "requested; the link `scans` leads to all"
    )
    links: list[Link]


class ScanOutcomeList(Document):
    """What became of the scans of a map, or of a version of one, in its order."""

    version: int = Field(description="of the map, whose scans these are", examples=[1])
    scans: list[ScanOutcome]
    links: list[Link]


class MapDocument(MapRecord, BuiltDocument):
    """A reference map as its version in use: the newest that is ready, and the newest where none is."""

    problem: JobProblem  # type: ignore[assignment]  # as RFC 9457 has it


class MapSummaryDocument(MapSummary, Document):
    """A reference map in short; the map itself tells its settings and what became of each scan."""

    problem: JobProblem  # type: ignore[assignment]  # as RFC 9457 has it
    links: list[Link]


class ScansPageRequest(Request):
    """Which part of the scans of a map or of a version."""

    limit: Limit = 100
    cursor: Cursor = None

    def after(self) -> ScanPosition | None:
        """Return where to go on. Raises BadRequest."""
        if self.cursor is None:
            return None
        job_id, before = decoded(self.cursor, str, count)
        return job_id, before


class AcceptedMap(Document):
    """A map that is going to be built."""

    map_id: str = Field(examples=["lobby"])
    job_id: str = Field(examples=["job-5f0c"])
    status: MapStatus
    links: list[Link]


class MapList(Document):
    """Maps, newest first."""

    maps: list[MapSummaryDocument]
    links: list[Link]


@router.post(
    "/maps",
    status_code=202,
    summary="Build a map",
    responses=SUBMITTED
    | documented(
        *BODY, "not_found", "conflict", "scan_unreadable", "queue_unavailable", "queue_full", *KEYED
    ),
    openapi_extra=bodies.documented(json=MapRequest, form=MapRequest, file="scans"),
)
async def create_map(
    request: HttpRequest, response: Response, services: Provided, keyed: Keyed
) -> AcceptedMap:
    """From scans uploaded before (`scan_ids`, or `scans` with poses for this map) or sent here, as files of a form.

    Their poses, where given, set the frame of the map.
    """

    def accept(record: MapRecord, job: JobRecord) -> Answer:
        return accepted(request, _accepted(request, record, job), job)

    if not keyed.seen:
        await run_in_threadpool(admit, services)
    async with bodies.received(request, services) as body:
        wanted = checked(MapRequest, body.fields)
        require_map(request, wanted.id)
        once = keyed.once(body, accept)
        record, job = await lane(services, body).run(_create, services, wanted, body, once)
    response.headers.update(job_headers(request, job))
    return _accepted(request, record, job)


@router.get("/maps", summary="List maps", responses=LISTED)
def list_maps(request: HttpRequest, services: Provided, asked: Annotated[PageRequest, Query()]) -> MapList:
    """In short, newest first; a key that is bound to maps sees those."""
    page = services.catalog.maps.page(only=maps_of_key(request), after=asked.after(), limit=asked.limit)
    links = list_links(request, asked, page, lambda record: (record.created, record.map_id))
    maps = [MapSummaryDocument(**dict(record), links=_links(record, request)) for record in page.items]
    return MapList(maps=maps, links=links)


@router.get("/maps/{map_id}", summary="Look at a map", responses=NAMED)
def get_map(request: HttpRequest, services: Provided, map_id: MapId) -> MapDocument:
    """Its version in use: state, what became of each scan, and extent and counts once it is ready.

    A map stays `ready` while a newer version builds, and when that fails; see its versions.
    """
    return map_document(services.catalog.maps.get(map_id, scans=SCANS_SHOWN), request)


@router.get("/maps/{map_id}/scans", summary="List the scans of a map", responses=SCANS_LISTED)
def list_map_scans(
    request: HttpRequest, services: Provided, map_id: MapId, asked: Annotated[ScansPageRequest, Query()]
) -> ScanOutcomeList:
    """What became of each scan of its version in use: pose, registration, warnings, and why it was left out.

    `next` goes on in the same version, also where a newer one came into use meanwhile.
    """
    return scan_list(request, services, map_id, None, asked)


@router.delete("/maps/{map_id}", status_code=204, summary="Delete a map", responses=NAMED)
async def delete_map(services: Provided, map_id: MapId) -> None:
    """With its versions, surveys, jobs and files; jobs that still run are stopped first. Its scans stay.

    Its jobs are a 404 from then on; of those that were stopped `job.ended` is told nevertheless.
    """
    await delete(services, _delete, services, map_id)


@router.get(
    "/maps/{map_id}/manifest",
    summary="The tiles of a map",
    response_model=Manifest,
    responses={200: {"description": "The tile manifest, fields as in Table A1 of the paper"}, **MADE},
)
async def get_manifest(services: Provided, map_id: MapId) -> Response:
    """Tile size, bounds, and every tile that is kept."""
    ready = await run_in_threadpool(services.catalog.maps.ready, map_id)
    return await manifest_response(services, ready.job_id)


@router.get(
    "/maps/{map_id}/cloud.ply",
    summary="The cloud of a map",
    response_class=Response,
    responses=files.documented(bodies.RAW, "The fused reference map, PLY") | MADE,
)
async def get_map_cloud(services: Provided, map_id: MapId) -> Response:
    """The fused reference map, in metres."""
    ready = await run_in_threadpool(services.catalog.maps.ready, map_id)
    return await cloud_response(services, ready.job_id, f"{map_id}.ply")


@router.get(
    "/maps/{map_id}/cloud.laz",
    summary="The cloud of a map, packed",
    response_class=Response,
    responses=files.documented(bodies.LAZ, "The fused reference map, LAZ 1.4") | MADE,
)
async def get_map_laz(services: Provided, map_id: MapId) -> Response:
    """The points of `cloud.ply` to the millimetre, for desktops. A map of release 0.1 has none."""
    ready = await run_in_threadpool(services.catalog.maps.ready, map_id)
    return await laz_response(services, ready.job_id, f"{map_id}.laz")


@router.put(
    "/maps/{map_id}/anchor",
    summary="Say where a map lies on the Earth",
    responses=documented(*BODY, "not_found"),
    openapi_extra=bodies.documented(json=AnchorRequest),
)
async def put_anchor(request: HttpRequest, services: Provided, map_id: MapId) -> MapDocument:
    """From now on every feature of the map, old or new, carries its footprint in WGS 84 as `geometry`."""
    async with bodies.received(request, services, takes=(bodies.JSON,), needs_space=False) as body:
        wanted = checked(AnchorRequest, body.fields)
    await services.writes.run(services.catalog.maps.set_anchor, map_id, wanted)
    return await run_in_threadpool(get_map, request, services, map_id)


@router.delete("/maps/{map_id}/anchor", status_code=204, summary="Take a map off the Earth", responses=NAMED)
async def delete_anchor(services: Provided, map_id: MapId) -> None:
    """Features have no `geometry` then; once more changes nothing."""
    await services.writes.run(services.catalog.maps.set_anchor, map_id, None)


def _accepted(request: HttpRequest, record: MapRecord, job: JobRecord) -> AcceptedMap:
    links = [link(request, f"/maps/{record.map_id}", "self"), monitor(request, job)]
    return AcceptedMap(map_id=record.map_id, job_id=job.job_id, status=record.status, links=links)


def _create(services: Services, wanted: MapRequest, body: Body, once: Once) -> tuple[MapRecord, JobRecord]:
    once.look()
    catalog = services.catalog
    model = services.cards.check_released(wanted.model or services.settings.model)
    with kept_scans(catalog, body, wanted) as scan_ids:
        record, job = catalog.maps.create(
            scan_ids=scan_ids,
            poses=wanted.poses,
            model=model,
            map_id=wanted.id,
            name=wanted.name,
            settings=wanted.settings.model_dump(mode="json", exclude_none=True),
            anchor=wanted.anchor,
            once=once,
        )
        submit(services, job, forget=lambda: catalog.maps.delete(record.map_id), once=once)
    return record, job


def _delete(services: Services, map_id: str) -> None:
    services.catalog.maps.summary(map_id)
    for job in services.catalog.jobs.unfinished(map_id):
        stop_if_open(services, job.job_id)
    services.catalog.maps.delete(map_id)


def map_document(record: MapRecord, request: HttpRequest) -> MapDocument:
    """Return a map with its links."""
    return MapDocument(**dict(record), links=_links(record, request))


def scan_list(
    request: HttpRequest, services: Services, map_id: str, number: int | None, asked: ScansPageRequest
) -> ScanOutcomeList:
    """Answer with a page of the scans of a version; of the one in use where none is named."""
    told = services.catalog.versions.scans(map_id, number, after=asked.after(), limit=asked.limit)
    links = [Link(href=here(request), rel="self"), link(request, f"/maps/{map_id}", "map")]
    if told.following is not None:
        job_id, before = told.following
        links.append(next_link(request, encoded(job_id, str(before))))
    return ScanOutcomeList(version=told.version, scans=list(told.items), links=links)


def _links(record: MapSummary, request: HttpRequest) -> list[Link]:
    path = f"/maps/{record.map_id}"
    links = [
        link(request, path, "self"),
        link(request, f"/jobs/{record.job_id}", "monitor"),
        link(request, f"{path}/scans", "scans"),
        link(request, f"{path}/versions", "version-history"),
    ]
    if record.status == "ready":
        links += [
            *file_links(request, path, record.tileset),
            link(request, f"{path}/changes", "changes", "application/geo+json"),
            link(request, f"{path}/objects", "objects", "application/geo+json"),
        ]
    return links


def file_links(request: HttpRequest, path: str, tileset: Tileset | None) -> list[Link]:
    """Return the links to the files of a map, or of a version of one, that lies at `path`."""
    return [
        link(request, f"{path}/manifest", "manifest"),
        link(request, f"{path}/cloud.ply", "cloud", bodies.RAW),
        link(request, f"{path}/cloud.laz", "cloud-laz", bodies.LAZ),
        *([link(request, f"{path}/tileset.json", "tileset")] if tileset is not None else []),
    ]


async def manifest_response(services: Services, job_id: str) -> Response:
    """Answer with the tile manifest of the version that a job built."""
    return await blob_response(services.catalog.blobs, blob_keys.map_manifest(job_id), media_type=bodies.JSON)


async def cloud_response(services: Services, job_id: str, filename: str) -> Response:
    """Answer with the cloud of the version that a job built."""
    key = blob_keys.map_cloud(job_id)
    return await blob_response(services.catalog.blobs, key, media_type=bodies.RAW, filename=filename)


async def laz_response(services: Services, job_id: str, filename: str) -> Response:
    """Answer with the packed cloud of the version that a job built."""
    key = blob_keys.map_laz(job_id)
    return await blob_response(services.catalog.blobs, key, media_type=bodies.LAZ, filename=filename)
