"""/maps/{id}/versions: the states of a map; surveys stay with the one that they were compared with."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from fastapi import Request as HttpRequest
from fastapi.concurrency import run_in_threadpool
from pydantic import Field

from service.api.http.answering import files
from service.api.http.answering.documents import Document, Link, checked, link
from service.api.http.answering.paging import PageRequest, list_links
from service.api.http.answering.problems import BODY, MADE, NAMED, JobProblem, documented
from service.api.http.dependencies import Provided, Services
from service.api.http.reading import bodies
from service.api.http.reading.bodies import Body
from service.api.http.reading.fields import Id
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
    submit,
)
from service.api.manifests import Manifest
from service.api.maps import (
    SCANS_LISTED,
    SCANS_SHOWN,
    BuiltDocument,
    MapId,
    ScanOutcomeList,
    ScansPageRequest,
    cloud_response,
    file_links,
    laz_response,
    manifest_response,
    scan_list,
)
from service.catalog.idempotency import Answer, Once
from service.catalog.records import JobRecord, MapStatus, VersionRecord, VersionSummary

router = APIRouter(tags=["versions"])
Number = Annotated[int, Path(ge=1, lt=1 << 31, examples=[1])]


class VersionRequest(ScansRequest):
    """A version of a map: of further scans, or of a survey that was accepted."""

    survey_id: Annotated[
        Id | None, Field(description="take over what this survey found changed; then without scans")
    ] = None


class VersionDocument(VersionRecord, BuiltDocument):
    """One state of a map, and what it was made from."""

    problem: JobProblem  # type: ignore[assignment]  # as RFC 9457 has it


class VersionSummaryDocument(VersionSummary, Document):
    """One state of a map in short; the version itself tells what became of each scan."""

    problem: JobProblem  # type: ignore[assignment]  # as RFC 9457 has it
    links: list[Link]


class AcceptedVersion(Document):
    """A version of a map that is going to be built; the one in use stays in use until then."""

    map_id: str = Field(examples=["lobby"])
    version: int = Field(examples=[2])
    job_id: str = Field(examples=["job-5f0c"])
    status: MapStatus
    links: list[Link]


class VersionList(Document):
    """Versions of one map, newest first."""

    versions: list[VersionSummaryDocument]
    links: list[Link]


@router.post(
    "/maps/{map_id}/versions",
    status_code=202,
    summary="Build a new version of a map",
    responses=SUBMITTED
    | documented(
        *BODY,
        "not_found",
        "not_ready",
        "failed",
        "conflict",
        "scan_unreadable",
        "queue_unavailable",
        "queue_full",
        *KEYED,
    ),
    openapi_extra=bodies.documented(json=VersionRequest, form=VersionRequest, file="scans"),
)
async def create_version(
    request: HttpRequest, response: Response, services: Provided, map_id: MapId, keyed: Keyed
) -> AcceptedVersion:
    """From the version in use and further scans (`scan_ids`, or files in `scans`), or an accepted survey (`survey_id`).

    Of a survey the tiles that it found changed are taken over; one whose placement is in doubt is a conflict. The frame
    and the ids of tiles stay. The version in use stays in use until the new one is ready; one version builds at a time.
    """

    def accept(record: VersionRecord, job: JobRecord) -> Answer:
        return accepted(request, _accepted(request, record, job), job)

    await run_in_threadpool(services.catalog.maps.ready, map_id)  # before a long upload
    if not keyed.seen:
        await run_in_threadpool(admit, services)
    async with bodies.received(request, services) as body:
        wanted, once = checked(VersionRequest, body.fields), keyed.once(body, accept)
        record, job = await lane(services, body).run(_create, services, map_id, wanted, body, once)
    response.headers.update(job_headers(request, job))
    return _accepted(request, record, job)


@router.get(
    "/maps/{map_id}/versions",
    summary="List the versions of a map",
    responses=documented("not_found", "invalid_request", "bad_request"),
)
def list_versions(
    request: HttpRequest, services: Provided, map_id: MapId, asked: Annotated[PageRequest, Query()]
) -> VersionList:
    """In short, newest first; the first in the list that is `ready` is the one in use."""
    page = services.catalog.versions.page(map_id, after=asked.after(), limit=asked.limit)
    links = list_links(request, asked, page, lambda record: (record.created, record.job_id))
    versions = [VersionSummaryDocument(**dict(one), links=_links(one, request)) for one in page.items]
    return VersionList(versions=versions, links=links)


@router.get("/maps/{map_id}/versions/{number}", summary="Look at a version of a map", responses=NAMED)
def get_version(request: HttpRequest, services: Provided, map_id: MapId, number: Number) -> VersionDocument:
    """Its state, what it was made from, what became of each scan, and its extent and counts once it is ready."""
    return version_document(services.catalog.versions.get(map_id, number, scans=SCANS_SHOWN), request)


@router.get(
    "/maps/{map_id}/versions/{number}/scans",
    summary="List the scans of a version of a map",
    responses=SCANS_LISTED,
)
def list_version_scans(
    request: HttpRequest,
    services: Provided,
    map_id: MapId,
    number: Number,
    asked: Annotated[ScansPageRequest, Query()],
) -> ScanOutcomeList:
    """What became of each of its scans: pose, registration, warnings, and why it was left out."""
    return scan_list(request, services, map_id, number, asked)


@router.delete(
    "/maps/{map_id}/versions/{number}",
    status_code=204,
    summary="Delete a version of a map",
    responses=documented("not_found", "conflict", "invalid_request"),
)
async def delete_version(services: Provided, map_id: MapId, number: Number) -> None:
    """With its job and files. Surveys that were compared with it stay readable, and so do its scans.

    The version in use, one that builds and one that a survey is being compared with are a conflict.
    """
    await delete(services, services.catalog.versions.delete, map_id, number)


@router.get(
    "/maps/{map_id}/versions/{number}/manifest",
    summary="The tiles of a version of a map",
    response_model=Manifest,
    responses={200: {"description": "The tile manifest, fields as in Table A1 of the paper"}, **MADE},
)
async def get_version_manifest(services: Provided, map_id: MapId, number: Number) -> Response:
    """Tile size, bounds, and every tile that is kept; a place has the same tile id in every version."""
    version = await run_in_threadpool(services.catalog.versions.ready, map_id, number)
    return await manifest_response(services, version.job_id)


@router.get(
    "/maps/{map_id}/versions/{number}/cloud.ply",
    summary="The cloud of a version of a map",
    response_class=Response,
    responses=files.documented(bodies.RAW, "The fused reference map, PLY") | MADE,
)
async def get_version_cloud(services: Provided, map_id: MapId, number: Number) -> Response:
    """The fused reference map, in metres."""
    version = await run_in_threadpool(services.catalog.versions.ready, map_id, number)
    return await cloud_response(services, version.job_id, f"{map_id}-{number}.ply")


@router.get(
    "/maps/{map_id}/versions/{number}/cloud.laz",
    summary="The cloud of a version of a map, packed",
    response_class=Response,
    responses=files.documented(bodies.LAZ, "The fused reference map, LAZ 1.4") | MADE,
)
async def get_version_laz(services: Provided, map_id: MapId, number: Number) -> Response:
    """The points of `cloud.ply` to the millimetre, for desktops. A map of release 0.1 has none."""
    version = await run_in_threadpool(services.catalog.versions.ready, map_id, number)
    return await laz_response(services, version.job_id, f"{map_id}-{number}.laz")


def _accepted(request: HttpRequest, record: VersionRecord, job: JobRecord) -> AcceptedVersion:
    map_path = f"/maps/{record.map_id}"
    here = link(request, f"{map_path}/versions/{record.version}", "self")
    return AcceptedVersion(
        map_id=record.map_id,
        version=record.version,
        job_id=job.job_id,
        status=record.status,
        links=[here, monitor(request, job), link(request, map_path, "map")],
    )


def _create(
    services: Services, map_id: str, wanted: VersionRequest, body: Body, once: Once
) -> tuple[VersionRecord, JobRecord]:
    once.look()
    catalog = services.catalog
    with kept_scans(catalog, body, wanted) as scan_ids:
        record, job = catalog.versions.create(
            map_id, scan_ids=scan_ids, poses=wanted.poses, survey_id=wanted.survey_id, once=once
        )
        submit(services, job, forget=lambda: catalog.versions.take_back(job.job_id), once=once)
    return record, job


def version_document(record: VersionRecord, request: HttpRequest) -> VersionDocument:
    """Return a version of a map with its links."""
    return VersionDocument(**dict(record), links=_links(record, request))


def _links(record: VersionSummary, request: HttpRequest) -> list[Link]:
    here = f"/maps/{record.map_id}/versions/{record.version}"
    links = [
        link(request, here, "self"),
        link(request, f"/jobs/{record.job_id}", "monitor"),
        link(request, f"/maps/{record.map_id}", "map"),
        link(request, f"{here}/scans", "scans"),
    ]
    if record.survey_id is not None:
        links.append(link(request, f"/surveys/{record.survey_id}", "survey"))
    if record.status == "ready":
        links += file_links(request, here, record.tileset)
    return links
