"""HEAD and OPTIONS for every path, and what `Allow` says of it (RFC 9110, Sections 9.3 and 10.2.1)."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, MutableMapping
from typing import Any

from fastapi.responses import Response
from starlette.routing import BaseRoute, Match, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
_HEAD = "spicd.head"  #: in a scope whose method was HEAD


def allowed(routes: Iterable[BaseRoute], scope: MutableMapping[str, Any]) -> tuple[str, ...]:
    """Return the methods that the path of a request takes; none where there is no such path."""
    taken = {method for method in METHODS if _has(routes, scope, method)}
    if not taken:
        return ()
    taken |= {"OPTIONS"} | ({"HEAD"} if "GET" in taken else set())
    return tuple(method for method in METHODS if method in taken)


def is_head(scope: MutableMapping[str, Any]) -> bool:
    """Tell whether a GET was a HEAD when it came, so that no file has to be read for it."""
    return scope["method"] == "HEAD" or scope.get(_HEAD) is True


class MethodsMiddleware:
    """Answers HEAD as GET without its content, and OPTIONS by `Allow`, where a path has no route of its own for them."""

    def __init__(self, app: ASGIApp, routes: Iterable[BaseRoute]) -> None:
        self._app, self._routes = app, routes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on (ASGI), or answer it."""
        method = scope["method"] if scope["type"] == "http" else None
        if method not in ("HEAD", "OPTIONS") or self._has_own(scope, method):
            await self._app(scope, receive, send)
        elif method == "HEAD":
            await self._head(scope, receive, send)
        elif names := METHODS if scope["path"] == "*" else allowed(self._routes, scope):
            await Response(status_code=204, headers={"Allow": ", ".join(names)})(scope, receive, send)
        else:
            await self._app(scope, receive, send)  # a 404

    def _has_own(self, scope: Scope, method: str) -> bool:
        """Tell whether a route is made for a method; Starlette's take HEAD for GET, and then read all of it."""
        own = [
            route
            for route in self._routes
            if not (isinstance(route, Route) and "GET" in (route.methods or ()))
        ]
        return _has(own, scope, method)

    async def _head(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer as to GET, and end with the headers: what goes on, as a stream of events does, is told to stop."""
        answered = asyncio.Event()
        asked = False

        async def ask() -> Message:
            nonlocal asked
            if asked:
                await answered.wait()
                return {"type": "http.disconnect"}
            asked = True
            return await receive()

        async def head(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
            elif not answered.is_set():
                await send({"type": "http.response.body", "body": b"", "more_body": False})
                answered.set()

        scope["method"], scope[_HEAD] = "GET", True
        try:
            await self._app(scope, ask, head)
        finally:
            scope["method"] = "HEAD"


def _has(routes: Iterable[BaseRoute], scope: MutableMapping[str, Any], method: str) -> bool:
    asked = {**scope, "method": method}
    return any(route.matches(asked)[0] is Match.FULL for route in routes)
