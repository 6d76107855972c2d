"""/uploads: files that come in pieces, by tus 1.0.0; the last piece makes a scan of them, as POST /scans does."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import time
from collections.abc import AsyncIterator, Callable
from datetime import timedelta
from typing import Annotated, Any, TypeVar, cast

import anyio
from fastapi import APIRouter, Depends, Path, Response
from fastapi import Request as HttpRequest
from fastapi.concurrency import run_in_threadpool
from pydantic import Field

from service.api.http.answering.documents import Document, Link, checked, link
from service.api.http.answering.problems import JobProblem, documented, located, response
from service.api.http.dependencies import Provided, Services
from service.api.http.guards.turns import Turn, Turns
from service.api.http.reading import tus
from service.api.http.reading.uploads import HEAD_BYTES, Upload, format_of, shown
from service.api.scans import ScanRequest, keep_scan
from service.catalog.files.disk import Disk
from service.catalog.files.uploads import OpenUpload, UploadRecord, Uploads
from service.catalog.records import Problem
from service.errors import (
    BadRequest,
    OffsetMismatch,
    ScanUnreadable,
    ServiceError,
    TooLarge,
    TooSlow,
    UploadBusy,
    WrongMediaType,
)
from service.settings import Settings

router = APIRouter(tags=["uploads"])
T = TypeVar("T")

FOLDER = "uploads"  #: in the data folder; on the disk of the blobs, so that a whole file becomes a scan by a rename
PIECE = 1 << 18  #: bytes handed to the disk at a time
KEEP_BYTES, KEEP_S = 4 << 20, 2.0  #: after as many, or as long, what came is put on the disk for sure
_CHUNK = 1 << 20
_FINAL = (ScanUnreadable, BadRequest)  #: the same bytes would end so again


class Receiver:
    """The uploads of this host, and who holds them."""

    def __init__(self, settings: Settings) -> None:
        self.uploads = Uploads(settings.data_dir / FOLDER, keep=timedelta(hours=settings.keep_uploads_hours))
        self._turns = Turns()

    @contextlib.asynccontextmanager
    async def held(self, upload_id: str) -> AsyncIterator[tuple[OpenUpload, Turn]]:
        """Hold an upload, in this process and among all. Raises NotFound, UploadBusy."""
        async with self._turns.of(upload_id) as turn:
            hold = self.uploads.opened(upload_id)
            one = await run_in_threadpool(hold.__enter__)
            try:
                yield one, turn
            finally:
                with anyio.CancelScope(shield=True):
                    await run_in_threadpool(hold.__exit__, None, None, None)


async def _receiver(request: HttpRequest) -> Receiver:
    return cast("Receiver", request.app.state.receiver)


Received = Annotated[Receiver, Depends(_receiver)]
UploadId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$", examples=["5f0c2b1f5f0c2b1f5f0c2b1f5f0c2b1f"])]


class UploadDocument(UploadRecord, Document):
    """One upload: how far it is, and the scan that it became or why it became none."""

    as_sent: str = Field(exclude=True)
    problem: JobProblem = None  # type: ignore[assignment]  # shown as a document
    links: list[Link] = Field(default_factory=list)


_ONE = documented("not_found", "invalid_request", "tus_version", "upload_busy")
_TAKES = documented(
    "tus_malformed",
    "incomplete_body",
    "too_slow",
    "too_large",
    "wrong_media_type",
    "tus_version",
    "scan_unreadable",
    "bad_request",
    "invalid_request",
    "checksum_mismatch",
    "disk_full",
    "unavailable",
)
_NUMBER = {"type": "integer", "minimum": 0}
_VERSION = tus.documented("Tus-Resumable", {"type": "string", "enum": [tus.VERSION]}, required=True)
_METADATA = tus.documented("Upload-Metadata", {"type": "string", "examples": ["filename aGFsbC5wbHk="]})
_DIGEST = "^(sha1 [A-Za-z0-9+/]{27}=|sha256 [A-Za-z0-9+/]{43}=)$"
_CHECKSUM = tus.documented("Upload-Checksum", {"type": "string", "pattern": _DIGEST})
_LENGTH = tus.documented("Upload-Length", _NUMBER, required=True)
_OFFSET = tus.documented("Upload-Offset", _NUMBER, required=True)
_PIECE = {"content": {tus.PIECE_TYPE: {"schema": {"type": "string", "format": "binary"}}}}


def _takes(*headers: dict[str, Any], piece: bool | None = None) -> dict[str, Any]:
    """Return what FastAPI cannot see of a request: its headers, and whether a piece is its body (None: it may be)."""
    body = {} if piece is False else {"requestBody": {"required": piece is True, **_PIECE}}
    return {"parameters": [_VERSION, *headers], **body}


@router.options("/uploads", status_code=204, summary="Which parts of tus are spoken", response_class=Response)
def get_upload_options(services: Provided) -> Response:
    """Versions, extensions, checksums and the largest file, as headers (tus 1.0.0, OPTIONS)."""
    headers = {
        "Allow": "OPTIONS, POST",
        "Tus-Version": tus.VERSION,
        "Tus-Extension": ",".join(tus.EXTENSIONS),
        "Tus-Checksum-Algorithm": ",".join(tus.ALGORITHMS),
        "Tus-Max-Size": str(services.settings.max_upload_bytes),
    }
    return Response(status_code=204, headers=headers)


@router.post(
    "/uploads",
    status_code=201,
    summary="Begin a resumable upload",
    response_class=Response,
    responses={
        201: {"description": "The upload is begun", "headers": located("/uploads/upload-7c1d", "upload")},
        **_TAKES,
        **documented("too_many_uploads"),
    },
    openapi_extra=_takes(_LENGTH, _METADATA, _CHECKSUM),
)
async def create_upload(request: HttpRequest, services: Provided, receiver: Received) -> Response:
    """Tell the size of a PLY, PCD, E57, LAS or LAZ in `Upload-Length`; its pieces go to the `Location` of the answer by PATCH.

    `Upload-Metadata` carries what the query of POST /scans does: `filename captured_at device_id pose frame`, each
    value in base64. A body, of the type application/offset+octet-stream, is the first piece.
    """
    tus.require_version(request.headers)
    length = tus.length_of(request.headers, services.settings.max_upload_bytes)
    metadata = tus.metadata_of(request.headers)
    wanted = checked(ScanRequest, dict(metadata), place="Upload-Metadata")  # before a long upload
    if length == 0:
        format_of(b"", shown(wanted.filename or "scan"))
    await run_in_threadpool(services.catalog.disk.require, length)
    as_sent = request.headers.get("upload-metadata", "")
    record = await run_in_threadpool(receiver.uploads.create, length, metadata, as_sent)
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() == tus.PIECE_TYPE:
        try:
            async with receiver.held(record.upload_id) as (one, turn):
                await _take(request, services, one, turn)
                record = one.record
        except ServiceError:
            await run_in_threadpool(_forget, receiver.uploads, record.upload_id)  # nobody was told its name
            raise
    root_path = request.scope.get("root_path", "")
    headers = {"Location": f"{root_path}/uploads/{record.upload_id}", **tus.told(record, root_path)}
    return Response(status_code=201, headers=headers)


@router.head(
    "/uploads/{upload_id}",
    summary="How far an upload is",
    response_class=Response,
    responses=_ONE | documented("scan_unreadable", "bad_request", "disk_full"),
    openapi_extra=_takes(piece=False),
)
async def get_upload_offset(
    request: HttpRequest, services: Provided, receiver: Received, upload_id: UploadId
) -> Response:
    """`Upload-Offset`: so many bytes are on the disk, and the next piece begins there.

    A piece that is still on its way on another connection is stopped. Of an upload that became a scan `Scan-Id` tells
    which; of one that was refused the status is that of the refusal, and GET tells why.
    """
    tus.require_version(request.headers)
    record = await run_in_threadpool(receiver.uploads.get, upload_id)
    if not record.has_ended:
        async with receiver.held(upload_id) as (one, _):
            await _finish(services, one)
            record = one.record
    if record.problem is not None:
        return response(record.problem.code, record.problem.detail)
    headers = tus.told(record, request.scope.get("root_path", ""))
    headers["Upload-Length"] = str(record.length)
    if record.as_sent:
        headers["Upload-Metadata"] = record.as_sent
    return Response(status_code=200, headers=headers)


@router.get(
    "/uploads/{upload_id}",
    summary="Look at an upload",
    responses=documented("not_found", "invalid_request"),
)
def get_upload(request: HttpRequest, receiver: Received, upload_id: UploadId) -> UploadDocument:
    """How far an upload is, and which scan it became or why none, also when the answer of the last PATCH was lost.

    This is no part of tus, and stops nobody who is sending.
    """
    record = receiver.uploads.get(upload_id)
    links = [link(request, f"/uploads/{upload_id}", "self")]
    if record.scan_id is not None:
        links.append(link(request, f"/scans/{record.scan_id}", "related"))
    return UploadDocument.model_validate({**dict(record), "links": links})


@router.patch(
    "/uploads/{upload_id}",
    status_code=204,
    summary="Send a piece of an upload",
    response_class=Response,
    responses=_ONE | _TAKES | documented("offset_mismatch"),
    openapi_extra=_takes(_OFFSET, _CHECKSUM, piece=True),
)
async def send_piece(
    request: HttpRequest, services: Provided, receiver: Received, upload_id: UploadId
) -> Response:
    """The bytes from `Upload-Offset` on, few or all that are left; a connection that breaks keeps what came.

    With `Upload-Checksum` (sha1, sha256) a piece is kept whole or not at all. The answer to the last one names the scan
    in `Scan-Id` and `Link`, or is the refusal that POST /scans would give.
    """
    tus.require_version(request.headers)
    async with receiver.held(upload_id) as (one, turn):
        _require_piece(request)
        offset = tus.offset_of(request.headers)
        await _finish(services, one)
        if one.record.problem is not None:
            return response(one.record.problem.code, one.record.problem.detail)
        if offset != one.record.offset:
            raise OffsetMismatch(
                f"the piece begins at {offset}, and {one.record.offset} bytes are here; go on there"
            )
        if not one.record.has_ended:
            await _take(request, services, one, turn)
        return Response(status_code=204, headers=tus.told(one.record, request.scope.get("root_path", "")))


@router.post(
    "/uploads/{upload_id}",
    status_code=204,
    summary="PATCH or DELETE, for who can send no other method",
    response_class=Response,
    responses=_ONE | _TAKES | documented("offset_mismatch", "method_not_allowed"),
    openapi_extra=_takes(
        tus.documented(
            "X-HTTP-Method-Override", {"type": "string", "enum": ["PATCH", "DELETE"]}, required=True
        ),
        tus.documented("Upload-Offset", _NUMBER),
        _CHECKSUM,
    ),
)
async def override_method(
    request: HttpRequest, services: Provided, receiver: Received, upload_id: UploadId
) -> Response:
    """`X-HTTP-Method-Override` names the method that is meant (tus 1.0.0)."""
    meant = request.headers.get("x-http-method-override", "")
    if meant == "PATCH":
        return await send_piece(request, services, receiver, upload_id)
    if meant == "DELETE":
        return await delete_upload(request, receiver, upload_id)
    return response(
        "method_not_allowed",
        "POST is not allowed here, unless X-HTTP-Method-Override is PATCH or DELETE",
        headers={"Allow": "HEAD, GET, PATCH, DELETE"},
    )


@router.delete(
    "/uploads/{upload_id}",
    status_code=204,
    summary="Give an upload up",
    response_class=Response,
    responses=_ONE,
    openapi_extra=_takes(piece=False),
)
async def delete_upload(request: HttpRequest, receiver: Received, upload_id: UploadId) -> Response:
    """Its bytes go; the scan that it became, if it did, stays."""
    tus.require_version(request.headers)
    async with receiver.held(upload_id) as (one, _):
        await run_in_threadpool(one.delete)
    return Response(status_code=204)


def _require_piece(request: HttpRequest) -> None:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != tus.PIECE_TYPE:
        raise WrongMediaType(
            f"the piece comes as {kind[:60] or 'no media type'}; send it as {tus.PIECE_TYPE}"
        )


async def _take(request: HttpRequest, services: Services, one: OpenUpload, turn: Turn) -> None:
    """Receive a piece, and make a scan of the file where it was the last.

    What came is kept however the receiving ends, but for a piece with a checksum, of which all is kept or nothing.
    """
    checksum = tus.checksum_of(request.headers)
    piece = _Piece(one, services.catalog.disk, checksum)
    try:
        with turn.receiving:
            await _receive(request, piece, one.missing, services.settings.upload_timeout_s)
        if turn.was_stopped:
            raise UploadBusy(
                "the upload goes on in a newer request, which stopped this one; what came is kept"
            )
        await run_in_threadpool(piece.verify)
    finally:
        with anyio.CancelScope(shield=True):
            await run_in_threadpool(piece.close)
    await _finish(services, one)


async def _receive(request: HttpRequest, piece: _Piece, most: int, seconds: float) -> None:
    """Hand the body to `piece`. Raises TooLarge, TooSlow, ClientDisconnect, DiskFull, ScanUnreadable, TusMalformed."""
    declared = request.headers.get("content-length", "0")
    if declared.isascii() and declared.isdigit() and int(declared[:19]) > most:
        raise TooLarge(f"the piece has {declared[:40]} bytes, and {most} are left of Upload-Length")
    try:
        async with asyncio.timeout(seconds) as clock:
            async for chunk in request.stream():
                most -= len(chunk)
                if most < 0:
                    raise TooLarge("the piece goes on behind Upload-Length")
                if piece.add(chunk):
                    await run_in_threadpool(piece.write)
    except TimeoutError as error:
        if not clock.expired():
            raise
        raise TooSlow(f"the piece took longer than {seconds:g} s; what came is kept, go on there") from error


class _Piece:
    """A piece on its way to the disk: gathered on the event loop, written in a thread."""

    def __init__(self, one: OpenUpload, disk: Disk, checksum: tus.Checksum | None) -> None:
        self._one, self._disk, self._checksum = one, disk, checksum
        self._hash = checksum.start() if checksum is not None else None
        self._waiting = bytearray()
        self._kept = time.monotonic()

    def add(self, chunk: bytes) -> bool:
        """Gather a chunk; whether there is enough to write, or what there is has waited long enough."""
        self._waiting += chunk
        return len(self._waiting) >= PIECE or time.monotonic() - self._kept > KEEP_S

    def write(self) -> None:
        """Write what was gathered, and from time to time have it on the disk for sure."""
        data = bytes(self._waiting)
        self._waiting.clear()
        if not data:
            return
        self._disk.require(len(data))
        self._one.append(data)
        if self._hash is not None:
            self._hash.update(data)
        self._look_at_head()
        is_due = (
            time.monotonic() - self._kept > KEEP_S or self._one.end - self._one.record.offset >= KEEP_BYTES
        )
        if self._checksum is None and is_due:
            self._one.keep()
            self._kept = time.monotonic()

    def verify(self) -> None:
        """Write the rest. Raises ChecksumMismatch, after which nothing of the piece is left."""
        self.write()
        if self._checksum is not None:
            try:
                self._checksum.check(self._hash)
            except ServiceError:
                self._one.drop()
                raise
            self._checksum = None  # it is what was sent, and is kept
            self._look_at_head()

    def close(self) -> None:
        """Keep what came, however it ended; of a piece that could not be verified nothing."""
        if self._one.record.has_ended:
            return
        if self._checksum is not None:
            self._one.drop()
            return
        with contextlib.suppress(ServiceError):  # the error that led here is the one to tell
            self.write()
        self._one.keep()

    def _look_at_head(self) -> None:
        """Refuse what is no scan as soon as its first bytes are here. Raises ScanUnreadable."""
        one = self._one
        if one.record.format is not None or one.end < min(HEAD_BYTES, one.record.length):
            return
        if self._checksum is None:
            _noted(one, lambda: one.note_format(format_of(one.head(HEAD_BYTES), _filename(one))))


def _filename(one: OpenUpload) -> str:
    return shown(one.record.metadata.get("filename", "scan"))


async def _finish(services: Services, one: OpenUpload) -> None:
    """Make a scan of an upload that is whole and is none yet; a thread of uploads hashes and keeps it."""
    if one.record.is_whole and not one.record.has_ended:
        await services.uploads.run(_become, services, one)


def _become(services: Services, one: OpenUpload) -> None:
    """Raises what POST /scans raises; what would end so again is noted with the upload."""

    def become() -> None:
        wanted = checked(ScanRequest, dict(one.record.metadata), place="Upload-Metadata")
        with one.copy() as path:
            upload = _whole(one, path)
            record, _ = keep_scan(services.catalog, upload, wanted)
        one.become(record.scan_id)

    _noted(one, become)


def _whole(one: OpenUpload, path: Any) -> Upload:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            size += len(chunk)
    return Upload(
        path=path,
        filename=_filename(one),
        format=format_of(one.head(HEAD_BYTES), _filename(one)),
        size=size,
        sha256=digest.hexdigest(),
    )


def _noted(one: OpenUpload, call: Callable[[], T]) -> T:
    """Call, and note with the upload what would end in the same error again."""
    try:
        return call()
    except _FINAL as error:
        one.refuse(Problem.of(error))
        raise


def _forget(uploads: Uploads, upload_id: str) -> None:
    with contextlib.suppress(ServiceError), uploads.opened(upload_id) as one:
        one.delete()
