"""What becomes of an answer on its way out: its ETag, 304 for who has it already, gzip, and its digest.

A document is answered with the ETag of its bytes, strong; one that says when it was written (`timeStamp`) has a weak
one of all else. Files bring their own (`service/api/http/answering/files.py`). What is gzipped has other bytes than what is not,
so that its ETag is made weak (RFC 9110, Section 8.8.1).
"""

from __future__ import annotations

import base64
import hashlib
import re
import zlib
from collections.abc import Callable
from email.utils import parsedate_to_datetime
from typing import Any, ParamSpec, TypeVar

from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.http.reading.codings import GZIP, accepts_gzip, packed, packer_of, shrinks
from service.api.http.reading.digests import digest_of, wanted

P = ParamSpec("P")
T = TypeVar("T")

SMALLEST = 1000  #: bytes of a document that are worth gzip
_AT_ONCE = 1 << 16  #: bytes that are hashed or packed without a thread
_WRITTEN = re.compile(rb'"timeStamp":\s?"[^"]{0,40}"')  #: of a collection, OGC API - Features
#: RFC 9110, Section 15.4.5; and the policy of a page, for what a 304 says takes its place in a browser's cache.
_IN_304 = frozenset(
    {
        "etag",
        "cache-control",
        "content-security-policy",
        "vary",
        "last-modified",
        "expires",
        "content-location",
        "date",
        "link",
    }
)


class RepresentationMiddleware:
    """Adds to every answer what holds for all; see above."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on (ASGI), and its answer through an `_Answer`."""
        answer = _Answer(scope, send) if scope["type"] == "http" else None
        await self._app(scope, receive, send if answer is None else answer.send)


class _Answer:
    """One answer: held back until its first piece tells whether it is whole."""

    def __init__(self, scope: Scope, send: Send) -> None:
        self._asked, self._is_get, self._send = Headers(scope=scope), scope["method"] == "GET", send
        self._start: Message | None = None
        self._packer: zlib._Compress | None = None

    async def send(self, message: Message) -> None:
        """Take a message of the app."""
        if message["type"] == "http.response.start":
            await self._begin(message)
        elif message["type"] != "http.response.body":
            await self._send(message)
        elif self._start is None:
            await self._go_on(message)
        elif message.get("more_body", False):
            start, self._start = self._start, None
            await self._stream(start, message)
        else:
            start, self._start = self._start, None
            await self._whole(start, message)

    async def _begin(self, start: Message) -> None:
        headers = MutableHeaders(scope=start)
        media_type = headers.get("content-type", "")
        if shrinks(media_type):
            add_vary(headers, "Accept-Encoding")
        if media_type.startswith("text/event-stream"):
            await self._send(start)  # its headers tell who follows that it is connected
        else:
            self._start = start

    async def _whole(self, start: Message, message: Message) -> None:
        """Send a document, or say that it is known."""
        headers, body = MutableHeaders(scope=start), message.get("body", b"")
        if (
            not body and int(headers.get("content-length", 0)) > 0
        ):  # the HEAD of a file, which nobody has read
            await self._stream(start, message)
            return
        is_document = self._is_get and start["status"] == 200
        if is_document and "etag" not in headers and "no-store" not in headers.get("cache-control", ""):
            headers["ETag"] = await _heavy(len(body), _etag, body, headers.get("content-type", ""))
        if is_document and is_known(self._asked, headers):
            await self._send({**start, "status": 304, "headers": not_modified(headers).raw})
            await self._send({**message, "body": b""})
            return
        if self._may_pack(start["status"], headers):
            body = await _heavy(len(body), packed, body)
            self._mark(headers)
        if "content-length" in headers and start["status"] not in (204, 304):
            headers["Content-Length"] = str(len(body))
        if start["status"] == 200:
            await self._add_digests(headers, body)
        await self._send(start)
        await self._send({**message, "body": body})

    async def _stream(self, start: Message, message: Message) -> None:
        headers = MutableHeaders(scope=start)
        if self._may_pack(start["status"], headers):
            self._packer = packer_of()
            self._mark(headers)
            del headers["content-length"]
        await self._send(start)
        await self._go_on(message)

    async def _go_on(self, message: Message) -> None:
        if self._packer is None:
            await self._send(message)
            return
        piece, more = message.get("body", b""), message.get("more_body", False)
        piece = await _heavy(len(piece), self._packer.compress, piece)
        if not more:
            piece += self._packer.flush()
        if piece or not more:
            await self._send({**message, "body": piece})

    def _may_pack(self, status: int, headers: Headers) -> bool:
        return (
            status not in (204, 206, 304)
            and int(headers.get("content-length", SMALLEST)) >= SMALLEST
            and "content-encoding" not in headers
            and shrinks(headers.get("content-type", ""))
            and accepts_gzip(self._asked)
        )

    @staticmethod
    def _mark(headers: MutableHeaders) -> None:
        """Say that an answer is gzip; what held for its plain bytes alone goes."""
        headers["Content-Encoding"] = GZIP
        if (etag := headers.get("etag")) is not None and not etag.startswith("W/"):
            headers["ETag"] = f"W/{etag}"
        del headers["accept-ranges"]
        del headers["repr-digest"]

    async def _add_digests(self, headers: MutableHeaders, body: bytes) -> None:
        for name in ("Content-Digest", "Repr-Digest"):  # of a whole answer they are the same
            if name not in headers and (algorithm := wanted(self._asked, f"Want-{name}")) is not None:
                headers[name] = await _heavy(len(body), digest_of, algorithm, body)


def add_conditions(document: dict[str, Any]) -> None:
    """Write into an OpenAPI document that every GET may be answered by 304."""
    for operations in document.get("paths", {}).values():
        if "200" in (responses := operations.get("get", {}).get("responses", {})):
            responses["304"] = {"description": "The client has it already (`If-None-Match`)"}


def is_known(asked: Headers, headers: Headers) -> bool:
    """Tell whether a client has the answer with these headers (RFC 9110, Section 13.2.2, steps 3 and 4)."""
    etag = headers.get("etag")
    if (lines := asked.getlist("if-none-match")) and etag is not None:
        return any(_names(line, etag) for line in lines)
    since, modified = asked.get("if-modified-since"), headers.get("last-modified")
    if lines or since is None or modified is None:
        return False
    try:
        return parsedate_to_datetime(modified) <= parsedate_to_datetime(since)
    except (ValueError, TypeError):  # no date, or one without a zone
        return False


def not_modified(headers: Headers) -> MutableHeaders:
    """Return the headers that a 304 repeats (RFC 9110, Section 15.4.5)."""
    kept = MutableHeaders({name: value for name, value in headers.items() if name in _IN_304})
    if shrinks(headers.get("content-type", "")):
        add_vary(kept, "Accept-Encoding")
    return kept


def add_vary(headers: MutableHeaders, name: str) -> None:
    """Say that an answer depends on a header of the request, once."""
    named = [entry.strip() for entry in headers.get("vary", "").split(",") if entry.strip()]
    if name.lower() not in [entry.lower() for entry in named]:
        headers["Vary"] = ", ".join([*named, name])


def etag_of(data: bytes) -> str:
    """Return a strong ETag of these bytes."""
    return f'"{base64.urlsafe_b64encode(hashlib.sha256(data).digest()[:18]).decode()}"'


def _etag(body: bytes, media_type: str) -> str:
    if "json" not in media_type:
        return etag_of(body)
    rest, count = _WRITTEN.subn(b"", body, count=1)
    return f"W/{etag_of(rest)}" if count else etag_of(body)


def _names(line: str, etag: str) -> bool:
    """Compare weakly (RFC 9110, Section 8.8.3.2)."""
    bare = etag.removeprefix("W/")
    return line.strip() == "*" or any(entry.strip().removeprefix("W/") == bare for entry in line.split(","))


async def _heavy(size: int, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call in a thread where the bytes are many: no other request is answered meanwhile."""
    if size <= _AT_ONCE:
        return call(*args, **kwargs)
    return await run_in_threadpool(call, *args, **kwargs)
