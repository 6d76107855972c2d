"""Blobs as answers: with ETag, conditions and digests; from a local folder with ranges, from elsewhere as a stream."""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, Response, StreamingResponse
from starlette.datastructures import Headers
from starlette.types import Message, Receive, Scope, Send

from service.api.http.answering import problems
from service.api.http.answering.representations import etag_of, is_known, not_modified
from service.api.http.guards.methods import is_head
from service.api.http.reading.digests import field_of, wanted
from service.catalog.files.blobs import Blobs
from service.catalog.files.tilesets import ContentName, read_content
from service.errors import NotFound

#: Of what never changes under its address: a browser does not ask again, and no cache that people share keeps it.
IMMUTABLE = "private, max-age=31536000, immutable"

#: Of what may be another, or gone, the next time: kept, and used again only where the service says so (304).
REVALIDATED = "private, no-cache"

_DIGESTED_BYTES = 1 << 24  #: of a file whose digest is told unasked

#: What RFC 9110, Section 14.1.2 admits; another unit or another form is ignored, as Section 14.2 has it.
_RANGE = re.compile(
    r"bytes=\s*(\d{1,18}-\d{0,18}|-\d{1,18})(\s*,\s*(\d{1,18}-\d{0,18}|-\d{1,18}))*\s*", re.IGNORECASE
)
_ONE_RANGE = re.compile(r"bytes=\s*(?=[0-9]|-[0-9])([0-9]{0,18})-([0-9]{0,18})\s*", re.IGNORECASE)


async def blob_response(
    blobs: Blobs,
    key: str,
    *,
    media_type: str,
    filename: str | None = None,
    immutable: bool = False,
    asked_again: bool = False,
) -> Response:
    """Answer with the blob under `key`, as a download when it has a `filename`.

    `immutable` is said of what will never be another under its address, `asked_again` of what a cache has to ask for
    each time, because it names others that may be gone. Raises NotFound, BlobsUnavailable.
    """
    headers = {"Cache-Control": IMMUTABLE} if immutable else {}
    if asked_again:
        headers["Cache-Control"] = REVALIDATED
    try:
        path = await run_in_threadpool(blobs.path, key) if blobs.is_local else None
        if path is not None:
            status = await run_in_threadpool(path.stat)
            headers["ETag"] = etag_of(f"{key} {status.st_size} {status.st_mtime_ns}".encode())
            return LocalFile(
                path, headers=headers, media_type=media_type, filename=filename, stat_result=status
            )
        size, stamp, pieces = await blobs.open_stream(key)
        first = await anext(pieces, b"")  # while the answer can still be a problem
    except FileNotFoundError as error:
        raise NotFound(f"{key} is not kept; the job that makes it may have left it out") from error
    headers |= {"Content-Length": str(size), "ETag": etag_of(f"{key} {stamp}".encode())}
    if filename is not None:
        headers["Content-Disposition"] = f'attachment; filename="{filename}"'
    return _Stream(_continued(first, pieces), media_type=media_type, headers=headers)


async def content_response(blobs: Blobs, key: str, name: ContentName, *, media_type: str) -> Response:
    """Answer with one content of a tileset, which is small and never changes. Raises NotFound, BlobsUnavailable."""
    try:
        content = await run_in_threadpool(read_content, blobs, key, name)
    except FileNotFoundError as error:
        raise NotFound(str(error)) from error
    etag = etag_of(f"{key} {name.offset} {name.length}".encode())
    return _Held(content, media_type=media_type, headers={"Cache-Control": IMMUTABLE, "ETag": etag})


def documented(media_type: str, what: str) -> dict[int | str, dict[str, Any]]:
    """Return the answers of a route that answers with a file, for the generated API description."""
    content = {media_type: {"schema": {"type": "string", "format": "binary"}}}
    return {
        200: {"description": what, "content": content},
        206: {"description": f"{what}: the bytes that `Range` asks for", "content": content},
        **problems.documented("range_not_satisfiable"),
    }


class LocalFile(FileResponse):
    """A local file, read only where its bytes are wanted."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer (ASGI) with the file, a part of it, its headers alone, 304 or 416."""
        asked = Headers(scope=scope)
        if is_known(asked, self.headers):
            await _not_modified(self)(scope, receive, send)
            return
        await self._add_digest(wanted(asked, "Want-Repr-Digest"))
        if "range" in asked and not _RANGE.fullmatch(asked["range"]):
            scope = {**scope, "headers": [entry for entry in scope["headers"] if entry[0] != b"range"]}
        if is_head(scope):
            scope = {**scope, "method": "HEAD"}
        await super().__call__(scope, receive, _Ranged(scope, receive, send, self._size()).send)

    def _size(self) -> int:
        return 0 if self.stat_result is None else self.stat_result.st_size

    async def _add_digest(self, algorithm: str | None) -> None:
        """Say the digest of the whole file where that is wanted, or takes no time (RFC 9530, Section 3)."""
        if algorithm is not None or self._size() <= _DIGESTED_BYTES:
            arguments = algorithm or "sha-256", Path(self.path), self.headers["etag"]
            self.headers["Repr-Digest"] = await run_in_threadpool(_digest, *arguments)


class _Stream(StreamingResponse):
    """A file from elsewhere."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer (ASGI) with the file, or with 304."""
        if is_known(Headers(scope=scope), self.headers):
            await _not_modified(self)(scope, receive, send)
        else:
            await super().__call__(scope, receive, send)


class _Held(Response):
    """Bytes that are in memory, or one range of them; an answer to several is the whole (RFC 9110, Section 14.2)."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer (ASGI) with the bytes, a part of them, 304 or 416."""
        asked = Headers(scope=scope)
        self.headers["Accept-Ranges"] = "bytes"
        if is_known(asked, self.headers):
            await _not_modified(self)(scope, receive, send)
            return
        match = _ONE_RANGE.fullmatch(asked.get("range", ""))
        if match is None or asked.get("if-range", self.headers["etag"]) != self.headers["etag"]:
            await super().__call__(scope, receive, send)
            return
        await self._part(match[1], match[2])(scope, receive, send)

    def _part(self, first: str, last: str) -> Response:
        """Return the answer with the bytes from `first` to `last`; without `first` it is how many of the last ones."""
        size = len(self.body)
        begin = int(first) if first else max(size - int(last), 0)
        end = min(int(last) + 1, size) if first and last else size
        if begin >= size or (first and last and int(last) < int(first)):
            detail = f"the content has {size} bytes, and none in {first}-{last}"
            return problems.response(
                "range_not_satisfiable", detail, headers={"Content-Range": f"bytes */{size}"}
            )
        part = Response(self.body[begin:end], status_code=206, media_type=self.media_type)
        for name in ("Cache-Control", "ETag", "Accept-Ranges"):
            part.headers[name] = self.headers[name]
        part.headers["Content-Range"] = f"bytes {begin}-{end - 1}/{size}"
        return part


def _not_modified(answer: Response) -> Response:
    known = Response(status_code=304)
    known.raw_headers = not_modified(answer.headers).raw
    return known


class _Ranged:
    """Turns the refusal of a range into a problem."""

    def __init__(self, scope: Scope, receive: Receive, send: Send, size: int) -> None:
        self._scope, self._receive, self._send, self._size = scope, receive, send, size
        self._refused = False

    async def send(self, message: Message) -> None:
        """Take a message of the file's answer."""
        if message["type"] == "http.response.start" and message["status"] in (400, 416):
            self._refused = True
            asked = Headers(scope=self._scope).get("range", "")
            detail = f"the file has {self._size} bytes, and none in {asked[:100]!r}"
            refusal = problems.response(
                "range_not_satisfiable", detail, headers={"Content-Range": f"bytes */{self._size}"}
            )
            await refusal(self._scope, self._receive, self._send)
        elif not self._refused:
            await self._send(message)


@functools.lru_cache(maxsize=1000)
def _digest(algorithm: str, path: Path, _etag: str) -> str:
    """Return the digest of a file as a header has it; remembered, for it takes a second for each gigabyte or so."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, algorithm.replace("-", ""))
    return field_of(algorithm, digest.digest())


async def _continued(first: bytes, pieces: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    yield first
    async for piece in pieces:
        yield piece
