"""The path that something in front puts before ours (`SPICD_ROOT_PATH`), whether or not it takes it off again."""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send


class PrefixMiddleware:
    """Gives every request the path that the client knows: `root_path` and then ours, as ASGI has it.

    A proxy that takes its prefix off sends `/maps`, one that does not `/spicd/maps`; both are the same request, and every
    link is made of `root_path`.
    """

    def __init__(self, app: ASGIApp, root_path: str) -> None:
        """Put `root_path` before ours; empty: what the server says, as `uvicorn --root-path` has it."""
        self._app, self._root_path = app, root_path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on (ASGI)."""
        if scope["type"] == "http":
            scope["root_path"] = self._root_path or scope.get("root_path", "")
            scope["path"] = _whole(scope["path"], scope["root_path"])
        await self._app(scope, receive, send)


def _whole(path: str, root: str) -> str:
    if not root or path.startswith(f"{root}/") or path == "*":
        return path
    return f"{root}/" if path == root else f"{root}{path}"
