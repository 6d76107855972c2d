"""/maps: reference maps, built by a job."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api import bodies, files
from service.api.bodies import Body
from service.api.documents import Document, Link, link
from service.api.files import blob_response
from service.api.map_documents import AcceptedMap, MapDocument, map_document
from service.api.paging import PageRequest, list_links
from service.api.problems import documented
from service.api.requests import MapRequest, checked
from service.api.schema import body_of
from service.api.services import Provided, Services
from service.api.submission import kept_scans, stop_if_open, submit
from service.api.values import Id
from service.catalog import blob_keys
from service.catalog.records import JobRecord, MapRecord

router = APIRouter(tags=["maps"])
MapId = Annotated[Id, Path()]


class MapList(Document):
    """Maps, newest first."""

    maps: list[MapDocument]
    links: list[Link]


@router.post(
    "/maps",
    status_code=202,
    summary="Build a map",
    responses=documented(
        "incomplete_body",
        "not_found",
        "conflict",
        "too_large",
        "wrong_media_type",
        "bad_request",
        "invalid_request",
        "scan_unreadable",
        "queue_unavailable",
    ),
    openapi_extra=body_of(json=MapRequest, form=MapRequest, file="scans"),
)
async def create_map(request: Request, response: Response, services: Provided) -> AcceptedMap:
    """From scans uploaded before (`scan_ids`) or sent here (`scans`); their poses, where given, set the frame of the map."""
    async with bodies.received(
        request, services.settings, takes=(bodies.JSON, bodies.FORM), files="scans"
    ) as body:
        wanted = checked(MapRequest, body.fields)
        record, job = await run_in_threadpool(_create, services, wanted, body)
    monitor = link(request, f"/jobs/{job.job_id}", "monitor")
    response.headers["Location"] = monitor.href
    here = link(request, f"/maps/{record.map_id}", "self")
    return AcceptedMap(map_id=record.map_id, job_id=job.job_id, status=record.status, links=[here, monitor])


@router.get("/maps", summary="List maps", responses=documented("invalid_request", "bad_request"))
def list_maps(request: Request, services: Provided, asked: Annotated[PageRequest, Query()]) -> MapList:
    """Newest first."""
    page = services.catalog.maps.page(after=asked.after(), limit=asked.limit)
    links = list_links(request, page, lambda found: (found.created, found.map_id))
    return MapList(maps=[map_document(found, request) for found in page.items], links=links)


@router.get("/maps/{map_id}", summary="Look at a map", responses=documented("not_found", "invalid_request"))
def get_map(request: Request, services: Provided, map_id: MapId) -> MapDocument:
    """Its version in use: state, what became of each scan, and extent and counts once it is ready.

    A map stays `ready` while a newer version builds, and when that fails; see its versions.
    """
    return map_document(services.catalog.maps.get(map_id), request)


@router.delete(
    "/maps/{map_id}",
    status_code=204,
    summary="Delete a map",
    responses=documented("not_found", "invalid_request"),
)
def delete_map(services: Provided, map_id: MapId) -> None:
    """With its versions, surveys, jobs and files; jobs that still run are stopped first. Its scans stay."""
    services.catalog.maps.get(map_id)
    for job in services.catalog.jobs.open_of(map_id):
        stop_if_open(services, job.job_id)
    services.catalog.maps.delete(map_id)


@router.get(
    "/maps/{map_id}/manifest",
    summary="The tiles of a map",
    response_model=dict[str, Any],
    responses={
        200: {"description": "The tile manifest, fields as in Table A1 of the paper"},
        **documented("not_found", "not_ready", "invalid_request"),
    },
)
def get_manifest(services: Provided, map_id: MapId) -> Response:
    """Tile size, bounds, and every tile that is kept."""
    found = services.catalog.maps.ready(map_id)
    key = blob_keys.map_manifest(found.job_id)
    return blob_response(services.catalog.blobs, key, media_type="application/json")


@router.get(
    "/maps/{map_id}/cloud.ply",
    summary="The cloud of a map",
    response_class=Response,
    responses={
        **files.documented(bodies.RAW, "The fused reference map, PLY"),
        **documented("not_found", "not_ready", "invalid_request"),
    },
)
def get_map_cloud(services: Provided, map_id: MapId) -> Response:
    """The fused reference map, in metres."""
    found = services.catalog.maps.ready(map_id)
    return blob_response(
        services.catalog.blobs,
        blob_keys.map_cloud(found.job_id),
        media_type=bodies.RAW,
        filename=f"{map_id}.ply",
    )


def _create(services: Services, wanted: MapRequest, body: Body) -> tuple[MapRecord, JobRecord]:
    catalog = services.catalog
    model = services.cards.check(wanted.model or services.settings.model)
    with kept_scans(
        catalog,
        body.uploads,
        wanted.scan_ids,
        device_id=wanted.device_id,
        captured_at=wanted.captured_at,
    ) as scan_ids:
        record, job = catalog.maps.create(
            scan_ids=scan_ids,
            model=model,
            map_id=wanted.id,
            name=wanted.name,
            settings=wanted.settings.model_dump(mode="json", exclude_none=True),
            anchor=None if wanted.anchor is None else wanted.anchor.anchor(),
        )
        submit(services, job, forget=lambda: catalog.maps.delete(record.map_id))
    return record, job
