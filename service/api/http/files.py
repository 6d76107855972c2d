"""Blobs as answers: from a local folder with ETag and ranges, from elsewhere as a stream."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, Response, StreamingResponse

from service.catalog.blobs import Blobs
from service.errors import NotFound


async def blob_response(blobs: Blobs, key: str, *, media_type: str, filename: str | None = None) -> Response:
    """Answer with the blob under `key`, as a download when it has a `filename`. Raises NotFound, BlobsUnavailable."""
    try:
        path = await run_in_threadpool(blobs.path, key) if blobs.is_local else None
        if path is not None:
            return FileResponse(path, media_type=media_type, filename=filename)
        size, pieces = await blobs.open_stream(key)
        first = await anext(pieces, b"")  # while the answer can still be a problem
    except FileNotFoundError as error:
        raise NotFound(f"{key} is not kept; the job that makes it may have left it out") from error
    headers = {"Content-Length": str(size)}
    if filename is not None:
        headers["Content-Disposition"] = f'attachment; filename="{filename}"'
    return StreamingResponse(_continued(first, pieces), media_type=media_type, headers=headers)


def documented(media_type: str, what: str) -> dict[int | str, dict[str, Any]]:
    """Return the 200 of a route that answers with a file, for the generated API description."""
    schema = {"type": "string", "format": "binary"}
    return {200: {"description": what, "content": {media_type: {"schema": schema}}}}


async def _continued(first: bytes, pieces: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    yield first
    async for piece in pieces:
        yield piece
