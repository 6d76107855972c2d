"""The id of a request and its line in the log.

The id is the client's `X-Request-ID`, where that is one, or made here. It is in the answer, and in every line that is
logged on the way. The line of a request names its route and not its path, and no query, header or body: what a client
sends may be secret.
"""

from __future__ import annotations

import logging
import re
import time
from uuid import uuid4

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import tracing
from service.logs import about, fields

log = logging.getLogger("spicd.requests")

HEADER = "X-Request-ID"
_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_QUIET = frozenset({"/health/live", "/health/ready", "/metrics"})  #: asked by machines every few seconds
_METHOD = re.compile(r"[A-Z]{1,10}")


class RequestLog:
    """Names each request, and logs one line when it has been answered; the outermost of the app (ASGI)."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on under its id."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = _Request(scope, receive, send)
        with about(request_id=request.id), tracing.request(Headers(scope=scope)) as trace:
            try:
                await self._app(scope, request.receive, request.send)
            finally:
                request.log()
                trace.answered(request.method, request.route, request.status, request.id)


class _Request:
    """One request while it is answered."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.id = _id_of(scope)
        self._scope, self._receive, self._send = scope, receive, send
        self.status: int | None = None
        self._received = self._sent = 0
        self._begun = time.perf_counter()

    @property
    def method(self) -> str:
        """The client's word, where it is one."""
        given: str = self._scope["method"]
        return given if _METHOD.fullmatch(given) else "other"

    @property
    def route(self) -> str:
        """The template of its route, once that is known."""
        return getattr(self._scope.get("route"), "path", "none")

    async def receive(self) -> Message:
        """Receive what the client sends, and count its bytes."""
        message = await self._receive()
        self._received += len(message.get("body", b""))
        return message

    async def send(self, message: Message) -> None:
        """Send the answer with the id, and count its bytes."""
        if message["type"] == "http.response.start":
            self.status = message["status"]
            MutableHeaders(scope=message)[HEADER] = self.id
        self._sent += len(message.get("body", b""))
        await self._send(message)

    def log(self) -> None:
        """Log the line; what machines ask every few seconds is of interest when it goes wrong."""
        quiet = self.route in _QUIET and self.status == 200
        line = {
            "method": self.method,
            "route": self.route,
            "status": self.status,
            "ms": round(1000 * (time.perf_counter() - self._begun), 1),
            "received_bytes": self._received,
            "sent_bytes": self._sent,
        }
        if key := self._scope.get("state", {}).get("key"):
            line["key_id"] = key
        words = (
            "%(method)s %(route)s %(status)s, %(ms).1f ms, %(received_bytes)d bytes in, %(sent_bytes)d out"
        )
        log.log(
            logging.DEBUG if quiet else logging.INFO,
            words + (", key %(key_id)s" if key else ""),
            line,
            extra=fields(**line),
        )


def _id_of(scope: Scope) -> str:
    given = Headers(scope=scope).get(HEADER, "")
    return given if _ID.fullmatch(given) else uuid4().hex
