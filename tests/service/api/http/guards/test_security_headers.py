"""Security headers: on every answer, with a policy for the two pages that have a script."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from tests.support.samples import add_map


@pytest.mark.parametrize(
    ("path", "cache"),
    [
        ("/maps", "private, no-cache"),
        ("/health/live", "private, no-cache"),
        ("/openapi.json", "private, no-cache"),
        ("/docs", "private, no-cache"),
        ("/nowhere", "no-store"),
        ("/maps/none", "no-store"),
    ],
)
def test_no_answer_may_be_framed_sniffed_or_embedded_elsewhere(
    client: TestClient, path: str, cache: str
) -> None:
    headers = client.get(path).headers
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert headers["Cache-Control"] == cache


def test_an_unexpected_error_bears_them_too(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.catalog.maps.Maps.page", None)
    answer = client.get("/maps")
    assert answer.status_code == 500
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_a_file_may_be_asked_for_again_by_its_etag(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog)
    catalog.blobs.put_bytes(blob_keys.map_cloud(job_id), b"ply\n")
    answer = client.get("/maps/lobby/cloud.ply")
    assert answer.status_code == 200
    assert answer.headers["Cache-Control"] == "private, no-cache"


@pytest.mark.parametrize("path", ["/", "/docs", "/redoc"])
def test_a_page_that_is_asked_for_again_keeps_the_policy_that_it_came_with(
    client: TestClient, path: str
) -> None:
    """What a 304 says takes the place of what a browser has kept (RFC 9111, Section 4.3.4)."""
    asked = {"Accept": "text/html"}
    page = client.get(path, headers=asked)
    again = client.get(path, headers={**asked, "If-None-Match": page.headers["ETag"]})
    assert again.status_code == 304
    assert again.headers["Content-Security-Policy"] == page.headers["Content-Security-Policy"]


@pytest.mark.parametrize("path", ["/docs", "/redoc"])
def test_the_pages_run_the_scripts_that_they_hold_and_no_other(client: TestClient, path: str) -> None:
    page = client.get(path)
    policy = page.headers["Content-Security-Policy"]
    scripts = next(part for part in policy.split("; ") if part.startswith("script-src")).split()
    assert "'unsafe-inline'" not in scripts
    for script in re.findall(r"<script>(.*?)</script>", page.text, re.DOTALL):
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in scripts
    assert "'self'" in scripts
    assert page.text.count("openapi.json") == 1
