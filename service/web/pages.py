"""The viewer's page, and the files that it loads: what `make web` has built, answered from here alone.

The page is one file for everybody and tells nothing of what the service holds: it is public also where requests need a
key, and asks for that key itself. What it loads has its content's hash in its name, so that a browser asks once.
"""

from __future__ import annotations

import html
import re
from pathlib import Path

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse, Response
from starlette.exceptions import HTTPException

from service.api.http.answering.files import LocalFile
from service.api.http.answering.negotiation import preferred
from service.errors import NotAcceptable

BUILT = Path(__file__).parent / "built"

_JSON, _HTML = "application/json", "text/html"
_MEDIA_TYPES = {
    ".js": "text/javascript",
    ".css": "text/css",
    ".txt": "text/plain",
}
_HASHED = re.compile(r".+-[A-Z0-9]{8}\.\w+")  #: names that esbuild gives (`[name]-[hash]`)
_FOR_EVER = "public, max-age=31536000, immutable"
_SELF = "'self'"
_BASE = '<base href="/" />'

#: Its own files and addresses alone (CSP Level 3); `data:` and `blob:` are of pictures that were fetched with a key.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "worker-src 'self'; base-uri 'self'; form-action 'none'"
)

_NOT_BUILT = """\
<!doctype html>
<html lang="en">
  <head>
    <meta charset="utf-8" />
    <base href="/" />
    <title>SPICD</title>
    <meta name="viewport" content="width=device-width, initial-scale=1" />
    <meta name="color-scheme" content="light dark" />
    <link rel="icon" href="data:," />
  </head>
  <body>
    <h1>SPICD</h1>
    <p>The service runs. Its viewer is not built on this machine: <code>make web</code> builds it, and this page then shows it.</p>
    <p><a href="docs">The API's description</a>, <a href="maps">the maps</a>, <a href="health/ready">the service's state</a>.</p>
  </body>
</html>
"""


def add_viewer(app: FastAPI) -> None:
    """Add the files that the page loads, `/web/{name}`, to an app; `/` itself is the landing page's."""

    async def asset(request: Request) -> Response:
        return await run_in_threadpool(_asset, request.app.state.viewer, request.path_params["name"])

    app.state.viewer = BUILT
    app.add_route("/web/{name}", asset, include_in_schema=False)


def wants_page(request: Request) -> bool:
    """Tell whether who asks would rather have a page than JSON, as browsers do; without a word of it, JSON."""
    try:
        return preferred(request, (_JSON, _HTML)) == _HTML
    except NotAcceptable:
        return False


async def viewer_page(request: Request, *, frames: tuple[str, ...]) -> HTMLResponse:
    """Return the page, or one that says how to build it. Pages of the origins `frames` may show it in a frame."""
    text = await run_in_threadpool(_page, request.app.state.viewer)
    base = html.escape(f"{request.scope.get('root_path', '')}/")
    page = HTMLResponse(text.replace(_BASE, f'<base href="{base}" />', 1))
    page.headers["Content-Security-Policy"] = f"{_POLICY}; frame-ancestors {' '.join([_SELF, *frames])}"
    page.headers["Vary"] = "Accept"
    page.headers["Cache-Control"] = "no-cache"
    return page


def _page(built: Path) -> str:
    try:
        return (built / "index.html").read_text()
    except FileNotFoundError:
        return _NOT_BUILT


def _asset(built: Path, name: str) -> Response:
    """Return a file of the bundle; the page itself has its own address. Raises HTTPException."""
    path = built / name
    media_type = _MEDIA_TYPES.get(path.suffix)
    if media_type is None or path.parent != built or not path.is_file():
        raise HTTPException(404)
    cache = {"Cache-Control": _FOR_EVER if _HASHED.fullmatch(name) else "no-cache"}
    return LocalFile(path, media_type=media_type, headers=cache, stat_result=path.stat())
