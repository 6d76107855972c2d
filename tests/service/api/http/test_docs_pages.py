"""/docs and /redoc: whole without the internet."""

from __future__ import annotations

import re

import pytest
from fastapi.testclient import TestClient

PAGES = ["/docs", "/redoc"]
SOURCE = re.compile(r'(?:src|href)="([^"]+)"')


@pytest.mark.parametrize("path", PAGES)
def test_a_page_names_nothing_of_another_host(client: TestClient, path: str) -> None:
    page = client.get(path)
    assert not re.search(r"(https?:)?//\w", page.text)
    assert "http" not in page.headers["Content-Security-Policy"]


@pytest.mark.parametrize("path", PAGES)
def test_what_a_page_loads_is_served_and_may_be_kept(client: TestClient, path: str) -> None:
    sources = [source for source in SOURCE.findall(client.get(path).text) if source != "data:,"]
    assert sources
    for source in sources:
        answer = client.get(source)
        assert answer.status_code == 200
        assert answer.headers["Content-Type"].startswith(
            "text/css" if source.endswith("css") else "text/javascript"
        )
        assert answer.headers["Cache-Control"] == "public, max-age=31536000, immutable"
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert len(answer.content) > 100_000
        assert client.get(source, headers={"If-None-Match": answer.headers["ETag"]}).status_code == 304


def test_no_other_file_and_no_other_release_is_served(client: TestClient) -> None:
    release = SOURCE.findall(client.get("/docs").text)[0].split("/")[2]
    for path in (
        f"/docs/{release}/favicon.png",
        "/docs/0/swagger-ui.css",
        f"/docs/{release}/..%2F__init__.py",
    ):
        answer = client.get(path)
        assert answer.status_code == 404
        assert answer.json()["type"] == "urn:spicd:problem:not_found"
