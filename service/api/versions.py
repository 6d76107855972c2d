"""/maps/{id}/versions: the states of a map; surveys stay with the one that they were compared with."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api import bodies, files
from service.api.bodies import Body
from service.api.documents import Document, Link, link
from service.api.files import blob_response
from service.api.map_documents import AcceptedVersion, VersionDocument, version_document
from service.api.paging import PageRequest, list_links
from service.api.problems import documented
from service.api.requests import VersionRequest, checked
from service.api.schema import body_of
from service.api.services import Provided, Services
from service.api.submission import kept_scans, submit
from service.api.values import Id
from service.catalog import blob_keys
from service.catalog.records import JobRecord, VersionRecord

router = APIRouter(tags=["versions"])
MapId = Annotated[Id, Path()]
Number = Annotated[int, Path(ge=1, lt=1 << 31, examples=[1])]


class VersionList(Document):
    """Versions of one map, newest first."""

    versions: list[VersionDocument]
    links: list[Link]


@router.post(
    "/maps/{map_id}/versions",
    status_code=202,
    summary="Build a new version of a map",
    responses=documented(
        "incomplete_body",
        "not_found",
        "not_ready",
        "conflict",
        "too_large",
        "wrong_media_type",
        "bad_request",
        "invalid_request",
        "scan_unreadable",
        "queue_unavailable",
    ),
    openapi_extra=body_of(json=VersionRequest, form=VersionRequest, file="scans"),
)
async def create_version(
    request: Request, response: Response, services: Provided, map_id: MapId
) -> AcceptedVersion:
    """From the version in use and further scans (`scan_ids`, or files in `scans`), or an accepted survey (`survey_id`).

    Of a survey the tiles that it found changed are taken over. The frame and the ids of tiles stay. The version in use
    stays in use until the new one is ready; one version builds at a time.
    """
    await run_in_threadpool(services.catalog.maps.ready, map_id)  # before a long upload
    async with bodies.received(
        request, services.settings, takes=(bodies.JSON, bodies.FORM), files="scans"
    ) as body:
        wanted = checked(VersionRequest, body.fields)
        record, job = await run_in_threadpool(_create, services, map_id, wanted, body)
    monitor = link(request, f"/jobs/{job.job_id}", "monitor")
    response.headers["Location"] = monitor.href
    here = link(request, f"/maps/{map_id}/versions/{record.version}", "self")
    return AcceptedVersion(
        map_id=map_id,
        version=record.version,
        job_id=job.job_id,
        status=record.status,
        links=[here, monitor, link(request, f"/maps/{map_id}", "map")],
    )


@router.get(
    "/maps/{map_id}/versions",
    summary="List the versions of a map",
    responses=documented("not_found", "invalid_request", "bad_request"),
)
def list_versions(
    request: Request, services: Provided, map_id: MapId, asked: Annotated[PageRequest, Query()]
) -> VersionList:
    """Newest first; the first in the list that is `ready` is the one in use."""
    page = services.catalog.versions.page(map_id, after=asked.after(), limit=asked.limit)
    links = list_links(request, page, lambda found: (found.created, found.job_id))
    return VersionList(versions=[version_document(found, request) for found in page.items], links=links)


@router.get(
    "/maps/{map_id}/versions/{number}",
    summary="Look at a version of a map",
    responses=documented("not_found", "invalid_request"),
)
def get_version(request: Request, services: Provided, map_id: MapId, number: Number) -> VersionDocument:
    """Its state, what it was made from, what became of each scan, and its extent and counts once it is ready."""
    return version_document(services.catalog.versions.get(map_id, number), request)


@router.delete(
    "/maps/{map_id}/versions/{number}",
    status_code=204,
    summary="Delete a version of a map",
    responses=documented("not_found", "conflict", "invalid_request"),
)
def delete_version(services: Provided, map_id: MapId, number: Number) -> None:
    """With its job and files. Surveys that were compared with it stay readable, and so do its scans.

    The version in use, one that builds and one that a survey is being compared with are a conflict.
    """
    services.catalog.versions.delete(map_id, number)


@router.get(
    "/maps/{map_id}/versions/{number}/manifest",
    summary="The tiles of a version of a map",
    response_model=dict[str, Any],
    responses={
        200: {"description": "The tile manifest, fields as in Table A1 of the paper"},
        **documented("not_found", "not_ready", "invalid_request"),
    },
)
def get_version_manifest(services: Provided, map_id: MapId, number: Number) -> Response:
    """Tile size, bounds, and every tile that is kept; a place has the same tile id in every version."""
    found = services.catalog.versions.ready(map_id, number)
    key = blob_keys.map_manifest(found.job_id)
    return blob_response(services.catalog.blobs, key, media_type="application/json")


@router.get(
    "/maps/{map_id}/versions/{number}/cloud.ply",
    summary="The cloud of a version of a map",
    response_class=Response,
    responses={
        **files.documented(bodies.RAW, "The fused reference map, PLY"),
        **documented("not_found", "not_ready", "invalid_request"),
    },
)
def get_version_cloud(services: Provided, map_id: MapId, number: Number) -> Response:
    """The fused reference map, in metres."""
    found = services.catalog.versions.ready(map_id, number)
    return blob_response(
        services.catalog.blobs,
        blob_keys.map_cloud(found.job_id),
        media_type=bodies.RAW,
        filename=f"{map_id}-{number}.ply",
    )


def _create(
    services: Services, map_id: str, wanted: VersionRequest, body: Body
) -> tuple[VersionRecord, JobRecord]:
    catalog = services.catalog
    with kept_scans(
        catalog,
        body.uploads,
        wanted.scan_ids,
        device_id=wanted.device_id,
        captured_at=wanted.captured_at,
    ) as scan_ids:
        record, job = catalog.versions.create(map_id, scan_ids=scan_ids, survey_id=wanted.survey_id)
        submit(services, job, forget=lambda: catalog.versions.take_back(job.job_id))
    return record, job
