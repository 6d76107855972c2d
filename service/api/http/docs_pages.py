"""/docs and /redoc: the API's description as pages, each under a policy that admits its own script alone.

Both load their program from a CDN, as FastAPI has it; a browser without the internet shows an empty page.
"""

from __future__ import annotations

import base64
import hashlib
import re

from fastapi import FastAPI, Request
from fastapi.openapi.docs import get_redoc_html, get_swagger_ui_html
from fastapi.responses import HTMLResponse

_CDN = "https://cdn.jsdelivr.net"
_ICON = "https://fastapi.tiangolo.com"
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)
_COMMON = (
    "default-src 'none'; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


def add_pages(app: FastAPI) -> None:
    """Add the two pages to an app that was made without them."""

    async def docs(request: Request) -> HTMLResponse:
        page = get_swagger_ui_html(openapi_url=_description(request), title=app.title)
        styles = f"style-src 'unsafe-inline' {_CDN}; img-src 'self' data: {_ICON}"
        return _under(page, f"{_COMMON}; script-src {_CDN}{_hashes(page)}; {styles}")

    async def redoc(request: Request) -> HTMLResponse:
        page = get_redoc_html(openapi_url=_description(request), title=app.title, with_google_fonts=False)
        styles = f"style-src 'unsafe-inline'; img-src data: {_ICON} https://cdn.redoc.ly; worker-src blob:"
        return _under(page, f"{_COMMON}; script-src {_CDN}{_hashes(page)}; {styles}")

    app.add_route("/docs", docs, include_in_schema=False)
    app.add_route("/redoc", redoc, include_in_schema=False)


def _description(request: Request) -> str:
    return f"{request.scope.get('root_path', '')}/openapi.json"


def _hashes(page: HTMLResponse) -> str:
    """Return the sources of the page's own scripts, for a policy without 'unsafe-inline' (CSP Level 3, 6.7.2.3)."""
    scripts = _INLINE.findall(bytes(page.body).decode())
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    return "".join(f" 'sha256-{digest}'" for digest in digests)


def _under(page: HTMLResponse, policy: str) -> HTMLResponse:
    page.headers["Content-Security-Policy"] = policy
    return page
