"""A scan in as many pieces as it takes: `service.resumable` with the errors of this client."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, cast

import anyio
import httpx

from service import resumable
from service.client.documents import ScanDocument
from service.client.errors import ClientError, RequestRefused, Unreachable


def in_pieces(http: httpx.Client, path: Path, **how: Any) -> ScanDocument:
    """Send a file, and go on where an earlier attempt ended; `how` as in `resumable.upload`.

    Raises `RequestRefused`, `Unreachable` where nothing goes on for too long, `ClientError` and OSError where it cannot be read.
    """
    try:
        return cast(ScanDocument, resumable.upload(http, path, **how))
    except resumable.UploadRefused as refused:
        raise RequestRefused(refused.problem, refused.status) from refused
    except resumable.UploadStalled as stalled:
        raise Unreachable(str(stalled)) from stalled
    except resumable.UploadError as error:
        raise ClientError(str(error)) from error


async def in_pieces_async(http: httpx.AsyncClient, path: Path, **how: Any) -> ScanDocument:
    """Do the same in a thread, over connections of its own; what is called back is called there."""
    with httpx.Client(base_url=http.base_url, headers=http.headers, timeout=http.timeout) as own:
        return await anyio.to_thread.run_sync(partial(in_pieces, own, path, **how))
