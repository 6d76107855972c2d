"""Keeps pages of other sites from driving the service through a browser that can reach it.

Two ways lead there. A page may send a form or a `fetch` to any address, and the browser adds whatever the address
trusts: a loopback service trusts the machine (cross-site request forgery). And a page may have its own name resolve to
the service's address, after which the browser takes both for one site (DNS rebinding). The first is told by
`Sec-Fetch-Site` (W3C Fetch Metadata) and `Origin` (RFC 6454), which a page cannot write; the second by `Host`, which
then bears the page's name. The rule for origins is that of Go's `net/http.CrossOriginProtection`.
"""

from __future__ import annotations

import ipaddress
import re
import socket

from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.http.answering.problems import response
from service.api.http.answering.representations import add_vary
from service.api.http.guards.methods import METHODS
from service.settings import Settings

SAFE_METHODS = frozenset(
    {"GET", "HEAD", "OPTIONS"}
)  #: change nothing (RFC 9110, Section 9.2.1), here as well
EXPOSED_HEADERS = (
    "Accept-Encoding",
    "Accept-Ranges",
    "Allow",
    "Content-Digest",
    "Content-Crs",
    "Content-Disposition",
    "Content-Range",
    "ETag",
    "Idempotent-Replayed",
    "Link",
    "Location",
    "OGC-NumberMatched",
    "OGC-NumberReturned",
    "Repr-Digest",
    "Retry-After",
    "Scan-Id",
    "Tus-Checksum-Algorithm",
    "Tus-Extension",
    "Tus-Max-Size",
    "Tus-Resumable",
    "Tus-Version",
    "Upload-Expires",
    "Upload-Length",
    "Upload-Metadata",
    "Upload-Offset",
    "WWW-Authenticate",
    "X-Request-ID",
)
#: Headers that a page of a named origin may send; a browser asks for each that is not safelisted (Fetch, 4.8).
ALLOWED_HEADERS = (
    "Authorization",
    "Content-Digest",
    "Content-Encoding",
    "Content-Type",
    "Idempotency-Key",
    "If-Match",
    "If-Modified-Since",
    "If-None-Match",
    "If-Range",
    "Last-Event-ID",
    "Range",
    "Repr-Digest",
    "Tus-Resumable",
    "Upload-Checksum",
    "Upload-Length",
    "Upload-Metadata",
    "Upload-Offset",
    "Want-Content-Digest",
    "Want-Repr-Digest",
    "X-HTTP-Method-Override",
    "X-Request-ID",
)
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^\s:\[\]/@]+)(?::\d*)?")


def add_cross_site_checks(app: FastAPI, settings: Settings) -> None:
    """Have `app` refuse foreign hosts and origins, and let the named origins read its answers (CORS)."""
    origins = settings.origins()
    if origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=origins,
            allow_methods=METHODS,
            allow_headers=ALLOWED_HEADERS,
            expose_headers=EXPOSED_HEADERS,
        )
    app.add_middleware(CrossSiteMiddleware, hosts=allowed_hosts(settings), origins=frozenset(origins))


def allowed_hosts(settings: Settings) -> frozenset[str] | None:
    """Return the names that `Host` may bear beside addresses; None: any.

    Where every request needs a key any name will do: a page that rebinds its own name has no key.
    """
    if (named := settings.hosts()) is not None:
        return None if "*" in named else frozenset(named)
    if settings.requires_key():
        return None
    return frozenset({"localhost", socket.gethostname().lower(), settings.host.lower()})


class CrossSiteMiddleware:
    """Answers 403 to a `Host` that is none of the service's, and to a change that a foreign page asks for."""

    def __init__(self, app: ASGIApp, *, hosts: frozenset[str] | None, origins: frozenset[str]) -> None:
        self._app, self._hosts, self._origins = app, hosts, origins

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on (ASGI), or refuse it."""
        if scope["type"] == "http":
            headers = Headers(scope=scope)
            refusal = self._foreign_host(headers)
            if refusal is None and scope["method"] not in SAFE_METHODS:
                refusal = self._foreign_origin(headers)
            if refusal is not None:
                await response("forbidden", refusal)(scope, receive, send)
                return
        await self._app(scope, receive, self._varied(send) if self._origins else send)

    @staticmethod
    def _varied(send: Send) -> Send:
        """Tell caches that an answer depends on the origin, also of who had none (Fetch, Section 3.3.7).

        A browser that had shown a picture as it is would else give the same to a page of a named origin, which may then
        not read it.
        """

        async def vary(message: Message) -> None:
            if message["type"] == "http.response.start":
                add_vary(MutableHeaders(scope=message), "Origin")
            await send(message)

        return vary

    def _foreign_host(self, headers: Headers) -> str | None:
        """Return the sentence for a `Host` that is not ours. Without one no browser asks: HTTP/1.0 probes have none."""
        for host in headers.getlist("host"):
            if self._hosts is not None and host and not answers_to(host, self._hosts):
                return (
                    f"this service does not answer to the name {host[:100]!r}; ask by its address, or name this one "
                    "in SPICD_ALLOWED_HOSTS"
                )
        return None

    def _foreign_origin(self, headers: Headers) -> str | None:
        """Return the sentence for a page of another site; a client that is no browser sends neither header."""
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")
        if origin is not None and origin.lower() in self._origins:
            return None
        if site in ("same-origin", "none"):
            return None
        if site is None and (origin is None or origin.partition("://")[2] == headers.get("host")):
            return None
        return (
            f"a page of {(origin or 'another site')[:100]!r} may not change anything here; name its origin in "
            "SPICD_ALLOWED_ORIGINS"
        )


def answers_to(host: str, names: frozenset[str]) -> bool:
    """Tell whether a `Host` header is an address, or one of `names` (`*.example.org`: any below example.org).

    An address is never foreign: DNS rebinding needs a name. Probes of Kubernetes ask by address.
    """
    matched = _HOST.fullmatch(host)
    if matched is None:
        return False
    name = matched[1].lower().rstrip(".")
    if name in names or any(f"*.{parent}" in names for parent in _parents(name)):
        return True
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _parents(name: str) -> list[str]:
    labels = name.split(".")
    return [".".join(labels[start:]) for start in range(1, len(labels))]
