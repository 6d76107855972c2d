"""/scans: one file each, kept as it came."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api import bodies
from service.api.bodies import Body
from service.api.documents import Document, Link, ScanDocument, scan_document
from service.api.paging import PageRequest, list_links
from service.api.problems import documented
from service.api.requests import ScanQuery, ScanRequest, checked
from service.api.schema import body_of
from service.api.services import Provided
from service.api.values import Id
from service.catalog.catalog import Catalog
from service.catalog.records import ScanRecord
from service.errors import BadRequest

router = APIRouter(tags=["scans"])


class ScanList(Document):
    """Scans, newest first."""

    scans: list[ScanDocument]
    links: list[Link]


@router.post(
    "/scans",
    status_code=201,
    summary="Upload a scan",
    responses={
        200: {"model": ScanDocument, "description": "The same bytes from the same device were here already"},
        **documented(
            "incomplete_body",
            "conflict",
            "too_large",
            "wrong_media_type",
            "bad_request",
            "invalid_request",
            "scan_unreadable",
        ),
    },
    openapi_extra=body_of(raw=True, form=ScanRequest, file="file"),
)
async def upload_scan(
    request: Request,
    response: Response,
    services: Provided,
    asked: Annotated[ScanQuery, Query()],
) -> ScanDocument:
    """One PLY or PCD, as the raw body or as the field `file` of a form; it is read later, by the job that uses it.

    What is said of the scan stands in the query, or in the form, which wins. The same bytes from the same device
    are one scan: sent again with another `pose` or `captured_at`, it is corrected while no map or survey rests on it,
    and refused (409) once one does.
    """
    said = asked.model_dump(exclude_none=True)
    checked(ScanRequest, said, place="query")  # before a long upload
    async with bodies.received(
        request,
        services.settings,
        takes=(bodies.RAW, bodies.FORM),
        files="file",
        filename=asked.filename,
    ) as body:
        told = checked(ScanRequest, {**said, **body.fields})
        record, is_new = await run_in_threadpool(_keep, services.catalog, body, told)
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"{request.scope.get('root_path', '')}/scans/{record.scan_id}"
    return scan_document(record)


@router.get("/scans", summary="List scans", responses=documented("invalid_request", "bad_request"))
def list_scans(request: Request, services: Provided, asked: Annotated[PageRequest, Query()]) -> ScanList:
    """Newest first."""
    page = services.catalog.scans.page(after=asked.after(), limit=asked.limit)
    links = list_links(request, page, lambda scan: (scan.created, scan.scan_id))
    return ScanList(scans=[scan_document(scan) for scan in page.items], links=links)


@router.get(
    "/scans/{scan_id}", summary="Look at a scan", responses=documented("not_found", "invalid_request")
)
def get_scan(services: Provided, scan_id: Annotated[Id, Path()]) -> ScanDocument:
    """What is known of one scan."""
    return scan_document(services.catalog.scans.get(scan_id))


@router.delete(
    "/scans/{scan_id}",
    status_code=204,
    summary="Delete a scan",
    responses=documented("not_found", "conflict", "invalid_request"),
)
def delete_scan(services: Provided, scan_id: Annotated[Id, Path()]) -> None:
    """Only while no map or survey rests on it."""
    services.catalog.scans.delete(scan_id)


def _keep(catalog: Catalog, body: Body, said: ScanRequest) -> tuple[ScanRecord, bool]:
    if len(body.uploads) != 1:
        raise BadRequest(f"{len(body.uploads)} files in the form; send one, in the field 'file'")
    upload = body.uploads[0]
    record, is_new = catalog.scans.add(
        upload.path,
        filename=said.filename or upload.filename,
        format=upload.format,
        size=upload.size,
        sha256=upload.sha256,
        device_id=said.device_id,
        captured_at=said.captured_at,
        pose=said.pose,
    )
    if not is_new:
        record = catalog.scans.correct(record.scan_id, captured_at=said.captured_at, pose=said.pose)
    return record, is_new
