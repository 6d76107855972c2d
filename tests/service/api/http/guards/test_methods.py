"""HEAD, OPTIONS and `Allow`, on every path of the API."""

from __future__ import annotations

import re
from typing import Any

import anyio
from fastapi import FastAPI
from fastapi.responses import StreamingResponse
from fastapi.testclient import TestClient

from service.api.http.guards.access import SCOPES
from service.api.http.guards.methods import MethodsMiddleware
from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from tests.support.samples import add_map, add_survey, tile

PATHS = sorted({path for _, path in SCOPES})


def concrete(path: str) -> str:
    return re.sub(r"\{number\}", "1", re.sub(r"\{(?!number)\w+\}", "none", path))


def test_options_and_405_name_every_method_of_a_path(client: TestClient) -> None:
    for path in PATHS:
        check_allow(client, path)


def check_allow(client: TestClient, path: str) -> None:
    expected = {method for method, known in SCOPES if known == path} | {"OPTIONS"}
    expected |= {"HEAD"} if "GET" in expected else set()
    options = client.options(concrete(path))
    assert (options.status_code, options.content) == (204, b"")
    assert set(options.headers["Allow"].split(", ")) == expected
    refused = client.request("TRACE", concrete(path))
    assert refused.status_code == 405
    assert refused.json()["type"] == "urn:spicd:problem:method_not_allowed"
    assert set(refused.headers["Allow"].split(", ")) == expected
    assert refused.headers["Allow"] in refused.json()["detail"]


def test_what_is_no_path_is_404_for_every_method(client: TestClient) -> None:
    for method in ("GET", "HEAD", "OPTIONS", "POST", "TRACE"):
        assert client.request(method, "/nowhere").status_code == 404
    assert client.post("/nowhere").json()["type"] == "urn:spicd:problem:not_found"


READ = (
    "/maps",
    "/maps/lobby",
    "/maps/none",
    "/maps/lobby/changes",
    "/maps/lobby/cloud.ply",
    "/maps/lobby/manifest",
    "/jobs",
    "/openapi.json",
    "/docs",
    "/health/live",
    "/maps?limit=0",
)


def test_head_is_get_without_its_content(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog)
    add_survey(catalog, [tile(0, 0)])
    catalog.blobs.put_bytes(blob_keys.map_cloud(job_id), b"ply\n" * 50_000)
    catalog.blobs.put_bytes(blob_keys.map_manifest(job_id), b'{"tiles": []}')
    for path in READ:
        check_head(client, path)


def check_head(client: TestClient, path: str) -> None:
    head, get = client.head(path), client.get(path)
    assert head.content == b""
    assert head.status_code == get.status_code
    own = {"x-request-id", "date"} | (
        {"content-length"} if "changes" in path else set()
    )  # that tells the time
    assert {k: v for k, v in head.headers.items() if k not in own} == {
        k: v for k, v in get.headers.items() if k not in own
    }


def test_head_of_what_can_only_be_posted_is_405(client: TestClient) -> None:
    answer = client.head("/jobs/none/retry")
    assert answer.status_code == 405
    assert answer.headers["Allow"] == "POST, OPTIONS"


def app_with_a_stream() -> tuple[FastAPI, list[str]]:
    app, told = FastAPI(), list[str]()

    async def endless() -> Any:
        try:
            while True:
                told.append("event")
                yield b"event: x\n\n"
                await anyio.sleep(0.01)
        finally:
            told.append("ended")

    @app.get("/events")
    async def events() -> StreamingResponse:
        return StreamingResponse(endless(), media_type="text/event-stream")

    @app.head("/own")
    async def own() -> None:
        told.append("own")

    app.add_middleware(MethodsMiddleware, routes=app.router.routes)
    return app, told


def test_head_of_a_stream_without_end_ends_it() -> None:
    app, told = app_with_a_stream()
    answer = TestClient(app).head("/events")
    assert (answer.status_code, answer.content) == (200, b"")
    assert told[-1] == "ended"


def test_a_route_of_its_own_for_head_is_used() -> None:
    app, told = app_with_a_stream()
    assert TestClient(app).head("/own").status_code == 200
    assert told == ["own"]
