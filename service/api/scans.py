"""/scans: one file each, kept as it came."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from fastapi import Request as HttpRequest
from pydantic import Field

from service.api.http.answering.documents import Document, Link, Request, checked, link
from service.api.http.answering.paging import PageRequest, list_links
from service.api.http.answering.problems import BODY, LISTED, NAMED, documented, located
from service.api.http.dependencies import Provided
from service.api.http.reading import bodies
from service.api.http.reading.bodies import Body
from service.api.http.reading.fields import DeviceId, Frame, Id, Instant, Pose, Text
from service.api.http.reading.idempotency import KEYED, Keyed, answered
from service.api.http.reading.submission import delete, lane
from service.api.http.reading.uploads import Upload
from service.catalog.catalog import Catalog
from service.catalog.idempotency import ANY_TIMES, Answer, Once
from service.catalog.records import ScanRecord
from service.errors import BadRequest

router = APIRouter(tags=["scans"])


class ScanQuery(Request):
    """What may be said of one scan beside its raw bytes; `ScanRequest` is the same, checked further."""

    filename: Annotated[
        str | None,
        Field(max_length=255, description="shown again, and names the file in errors", examples=["hall.pcd"]),
    ] = None
    captured_at: Annotated[Instant | None, Field(description="RFC 3339")] = None
    device_id: DeviceId | None = None
    pose: Annotated[
        str | None,
        Field(
            description="map_from_sensor: 4x4 rows as JSON, or `x y z qx qy qz qw` (metres, unit quaternion)",
            examples=["2.5 0 0.35 0 0 0 1"],
        ),
    ] = None
    frame: Annotated[
        Frame | None,
        Field(description="that the pose leads to, such as `map` or `odom` (REP 105); kept and told"),
    ] = None


Start = Annotated[
    Pose | None,
    Field(
        description="map_from_sensor, a start for the registration: 4x4 row-major, or x y z qx qy qz qw "
        "(metres, unit quaternion)"
    ),
]


class ScanRequest(ScanQuery):
    """What may be said of one scan."""

    filename: Annotated[Text | None, Field(max_length=255, examples=["hall.pcd"])] = None
    pose: Start = None  # type: ignore[assignment]  # read from the text


class ScanDocument(ScanRecord, Document):
    """One uploaded scan."""


class ScanList(Document):
    """Scans, newest first."""

    scans: list[ScanDocument]
    links: list[Link]


@router.post(
    "/scans",
    status_code=201,
    summary="Upload a scan",
    responses={
        200: {
            "model": ScanDocument,
            "description": "The same bytes from the same device were here already",
            "headers": located("/scans/scan-2b1f", "scan"),
        },
        201: {"description": "The scan is kept", "headers": located("/scans/scan-2b1f", "scan")},
        **documented(*BODY, "conflict", "scan_unreadable", *KEYED),
    },
    openapi_extra=bodies.documented(raw=True, form=ScanRequest, file="file"),
)
async def upload_scan(
    request: HttpRequest,
    response: Response,
    services: Provided,
    asked: Annotated[ScanQuery, Query()],
    keyed: Keyed,
) -> ScanDocument:
    """One PLY, PCD, E57, LAS or LAZ, as the raw body or as the field `file` of a form; a job that uses it reads it later.

    What is said of the scan stands in the query, or in the form, which wins. The same bytes from the same device
    are one scan: sent again with another `pose` or `captured_at`, these are kept from then on, as the answer shows.
    Maps and surveys that were asked for before stay with what they were asked for with, and a request for one may name
    a pose of its own (`scans`).

    `openapi-typescript` types bytes as `string`: the head of this document has the line that sends a file.
    """

    def accept(record: ScanRecord, is_new: bool) -> Answer:
        location = link(request, f"/scans/{record.scan_id}", "self").href
        status = 201 if is_new else 200
        return answered(ScanDocument.of_row(record), status=status, headers={"Location": location})

    query = asked.model_dump(exclude_none=True)
    checked(ScanRequest, query, place="query")  # before a long upload
    async with bodies.received(
        request,
        services,
        takes=(bodies.RAW, bodies.FORM),
        files="file",
        filename=asked.filename,
    ) as body:
        wanted = checked(ScanRequest, {**query, **body.fields})
        once = keyed.once(body, accept)
        record, is_new = await lane(services, body).run(_keep, services.catalog, body, wanted, once)
    answer = accept(record, is_new)
    response.status_code = answer.status
    response.headers.update(answer.headers)
    return ScanDocument.of_row(record)


@router.get("/scans", summary="List scans", responses=LISTED)
def list_scans(request: HttpRequest, services: Provided, asked: Annotated[PageRequest, Query()]) -> ScanList:
    """Newest first."""
    page = services.catalog.scans.page(after=asked.after(), limit=asked.limit)
    links = list_links(request, asked, page, lambda scan: (scan.created, scan.scan_id))
    return ScanList(scans=[ScanDocument.of_row(scan) for scan in page.items], links=links)


@router.get("/scans/{scan_id}", summary="Look at a scan", responses=NAMED)
def get_scan(services: Provided, scan_id: Annotated[Id, Path()]) -> ScanDocument:
    """What is known of one scan."""
    return ScanDocument.of_row(services.catalog.scans.get(scan_id))


@router.delete(
    "/scans/{scan_id}",
    status_code=204,
    summary="Delete a scan",
    responses=documented("not_found", "conflict", "invalid_request"),
)
async def delete_scan(services: Provided, scan_id: Annotated[Id, Path()]) -> None:
    """Only while no map or survey rests on it."""
    await delete(services, services.catalog.scans.delete, scan_id)


def keep_scan(
    catalog: Catalog, upload: Upload, wanted: ScanRequest, once: Once = ANY_TIMES
) -> tuple[ScanRecord, bool]:
    """Make a file that arrived whole a scan, or find that it is one; says whether it is new.

    The answer is kept after it: cut off in between, the same bytes are the same scan.
    """
    record, is_new = catalog.scans.add(
        **{**asdict(upload), "filename": wanted.filename or upload.filename},
        device_id=wanted.device_id,
        captured_at=wanted.captured_at,
        pose=wanted.pose,
        frame=wanted.frame,
    )
    if not is_new:
        record = catalog.scans.correct(
            record.scan_id, captured_at=wanted.captured_at, pose=wanted.pose, frame=wanted.frame
        )
    once.note(record, is_new)
    return record, is_new


def _keep(
    catalog: Catalog, body: Body, wanted: ScanRequest, once: Once = ANY_TIMES
) -> tuple[ScanRecord, bool]:
    once.look()
    if len(body.uploads) != 1:
        raise BadRequest(f"{len(body.uploads)} files in the form; send one, in the field 'file'")
    return keep_scan(catalog, body.uploads[0], wanted, once)
