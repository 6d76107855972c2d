"""Blobs as answers: from a local folder with ETag and ranges, from elsewhere as a stream."""

from __future__ import annotations

from typing import Any

from fastapi.responses import FileResponse, Response, StreamingResponse

from service.catalog.blobs import Blobs
from service.errors import NotFound


def blob_response(blobs: Blobs, key: str, *, media_type: str, filename: str | None = None) -> Response:
    """Answer with the blob under `key`, as a download when it has a `filename`. Raises NotFound."""
    try:
        path = blobs.path(key)
        if path is not None:
            return FileResponse(path, media_type=media_type, filename=filename)
        headers = {"Content-Length": str(blobs.size(key))}
        if filename is not None:
            headers["Content-Disposition"] = f'attachment; filename="{filename}"'
        return StreamingResponse(blobs.stream(key), media_type=media_type, headers=headers)
    except FileNotFoundError as error:
        raise NotFound(f"{key} is not kept; the job that makes it may have left it out") from error


def documented(media_type: str, what: str) -> dict[int | str, dict[str, Any]]:
    """Return the 200 of a route that answers with a file, for the generated API description."""
    schema = {"type": "string", "format": "binary"}
    return {200: {"description": what, "content": {media_type: {"schema": schema}}}}
