"""Bodies of requests: JSON, a form with files, or one raw file, in memory that does not grow with the body."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from typing import Any

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from python_multipart.multipart import parse_options_header

from service.api.incoming import Incoming, Upload
from service.api.multipart import Form
from service.errors import BadRequest, TooLarge, WrongMediaType
from service.settings import Settings

PIECE = 1 << 20  #: bytes handed to the disk at a time
MAX_JSON_BYTES = 1 << 20
INCOMING = (
    "incoming"  #: folder in the data folder; on the disk of the blobs, so that keeping a file is a rename
)

JSON = "application/json"
FORM = "multipart/form-data"
RAW = "application/octet-stream"


@dataclass(frozen=True, kw_only=True, slots=True)
class Body:
    """What a request brought; the files go when the request ends."""

    fields: dict[str, Any] = field(default_factory=dict)
    uploads: tuple[Upload, ...] = ()


@contextlib.asynccontextmanager
async def received(
    request: Request, settings: Settings, *, takes: tuple[str, ...], files: str, filename: str | None = None
) -> AsyncIterator[Body]:
    """The body of a request in one of the media types `takes`.

    `files` names the form field of files; `filename` that of a raw body. Raises WrongMediaType, TooLarge,
    BadRequest, ScanUnreadable; leaves nothing behind whichever way it ends.
    """
    media_type, options = _media_type(request)
    if media_type not in takes:
        said = media_type or "no media type"
        raise WrongMediaType(f"the body comes as {said}; send it as {' or '.join(takes)}")
    folder = settings.data_dir / INCOMING
    limit = MAX_JSON_BYTES if media_type == JSON else settings.max_upload_bytes
    await run_in_threadpool(folder.mkdir, parents=True, exist_ok=True)
    kept = contextlib.ExitStack()
    try:
        if media_type == JSON:
            text = bytearray()
            await _pour(request, text.extend, limit=limit)
            yield Body(fields=_json(bytes(text)))
        elif media_type == FORM:
            if not options.get(b"boundary"):
                raise BadRequest("the Content-Type names no boundary; let the HTTP library write this header")
            form = Form(options[b"boundary"], folder, kept, frozenset({files}))
            await _pour(request, form.feed, limit=limit)
            form.finish()
            yield Body(fields=form.fields, uploads=tuple(form.uploads))
        else:
            file = kept.enter_context(Incoming(folder, filename or ""))
            await _pour(request, file.write, limit=limit)
            yield Body(uploads=(await run_in_threadpool(file.finish),))
    finally:
        await run_in_threadpool(kept.close)


async def _pour(request: Request, take: Callable[[bytes], None], *, limit: int) -> None:
    """Hand the body to `take` in pieces, in a thread. Raises TooLarge as soon as it is, also without a length."""
    declared = request.headers.get("content-length", "")
    if declared.isdigit() and int(declared) > limit:
        raise TooLarge(f"the body has {declared} bytes, more than the {limit} that are taken")
    size = 0
    piece = bytearray()
    async for chunk in request.stream():
        size += len(chunk)
        if size > limit:
            raise TooLarge(f"the body has more than the {limit} bytes that are taken")
        piece += chunk
        if len(piece) >= PIECE:
            await run_in_threadpool(take, bytes(piece))
            piece.clear()
    if piece:
        await run_in_threadpool(take, bytes(piece))


def _media_type(request: Request) -> tuple[str, dict[bytes, bytes]]:
    kind, options = parse_options_header(request.headers.get("content-type", ""))
    return kind.decode("latin-1").lower(), options


def _json(text: bytes) -> dict[str, Any]:
    if not text.strip():
        raise BadRequest("the body is empty; send a JSON object")
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadRequest(f"the body is not JSON: {error}") from error
    if not isinstance(fields, dict):
        raise BadRequest(f"the body is a JSON {type(fields).__name__}; send an object")
    return fields
