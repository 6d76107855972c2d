"""/docs and /redoc: the API's description as pages, each under a policy that admits its own scripts alone.

The programs behind them, Swagger UI and ReDoc, are files of the package fastapi-offline, answered from here: a browser
without the internet shows the pages, and nobody else learns who reads them.
"""

from __future__ import annotations

import base64
import hashlib
import re
from importlib.metadata import version
from pathlib import Path

import fastapi_offline
from fastapi import FastAPI, Request
from fastapi.openapi.docs import get_redoc_html, get_swagger_ui_html
from fastapi.responses import HTMLResponse, Response
from starlette.exceptions import HTTPException

from service.api.http.answering.files import LocalFile

_FOLDER = Path(fastapi_offline.__file__).parent / "static"
_FILES = {
    "swagger-ui-bundle.js": "text/javascript",
    "swagger-ui.css": "text/css",
    "redoc.standalone.js": "text/javascript",
}
_ICON = "data:,"
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)
_COMMON = (
    "default-src 'none'; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


def add_pages(app: FastAPI) -> None:
    """Add the two pages, and the files that they load, to an app that was made without them."""
    release = version("fastapi-offline")

    async def docs(request: Request) -> HTMLResponse:
        page = get_swagger_ui_html(
            openapi_url=_at(request, "/openapi.json"),
            title=app.title,
            swagger_js_url=_at(request, f"/docs/{release}/swagger-ui-bundle.js"),
            swagger_css_url=_at(request, f"/docs/{release}/swagger-ui.css"),
            swagger_favicon_url=_ICON,
        )
        styles = "style-src 'self' 'unsafe-inline'; img-src data:"
        return _under(page, f"{_COMMON}; script-src 'self'{_hashes(page)}; {styles}")

    async def redoc(request: Request) -> HTMLResponse:
        page = get_redoc_html(
            openapi_url=_at(request, "/openapi.json"),
            title=app.title,
            redoc_js_url=_at(request, f"/docs/{release}/redoc.standalone.js"),
            redoc_favicon_url=_ICON,
            with_google_fonts=False,
        )
        styles = "style-src 'unsafe-inline'; img-src data:; worker-src blob:"
        return _under(page, f"{_COMMON}; script-src 'self'{_hashes(page)}; {styles}")

    async def file(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in _FILES or request.path_params["release"] != release:
            raise HTTPException(404)
        cache = {
            "Cache-Control": "public, max-age=31536000, immutable"
        }  # another release has another address
        path = _FOLDER / name
        return LocalFile(path, media_type=_FILES[name], headers=cache, stat_result=path.stat())

    app.add_route("/docs", docs, include_in_schema=False)
    app.add_route("/redoc", redoc, include_in_schema=False)
    app.add_route("/docs/{release}/{name}", file, include_in_schema=False)


def _at(request: Request, path: str) -> str:
    return f"{request.scope.get('root_path', '')}{path}"


def _hashes(page: HTMLResponse) -> str:
    """Return the sources of the page's own scripts, for a policy without 'unsafe-inline' (CSP Level 3, 6.7.2.3)."""
    scripts = _INLINE.findall(bytes(page.body).decode())
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    return "".join(f" 'sha256-{digest}'" for digest in digests)


def _under(page: HTMLResponse, policy: str) -> HTMLResponse:
    page.headers["Content-Security-Policy"] = policy
    return page
