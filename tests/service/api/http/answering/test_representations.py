"""Answers on their way out: ETag and 304, gzip, what caches may do, digests of what is sent."""

from __future__ import annotations

import base64
import gzip
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from fastapi import FastAPI
from fastapi.responses import Response, StreamingResponse
from fastapi.testclient import TestClient

from service.api.http.answering.representations import RepresentationMiddleware
from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from tests.support.samples import (
    RememberingQueue,
    add_map,
    add_survey,
    catalog_of,
    running,
    settings_in,
    tile,
)

PLAIN = {"Accept-Encoding": "identity"}
PACKED = {"Accept-Encoding": "gzip"}
CLOUD = b"ply\n" + bytes(range(256)) * 1000
MANIFEST = b'{"tiles": [' + b"0, " * 60_000 + b"0]}"


@pytest.fixture
def lobby(client: TestClient, catalog: Catalog) -> str:
    """A map with its files, and a survey with a cloud; the id of the survey."""
    job_id = add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(i, 0) for i in range(20)])
    files = (blob_keys.map_cloud(job_id), blob_keys.map_laz(job_id))
    for key in (*files, blob_keys.survey_cloud(survey_id), blob_keys.survey_laz(survey_id)):
        catalog.blobs.put_bytes(key, CLOUD)
    catalog.blobs.put_bytes(blob_keys.survey_picture(survey_id), b"\x89PNG" + bytes(5000))
    catalog.blobs.put_bytes(blob_keys.map_manifest(job_id), MANIFEST)
    return survey_id


def sha256(data: bytes) -> str:
    return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"


PATHS = (
    "/maps",
    "/maps/lobby",
    "/maps/lobby/changes",
    "/surveys/{}",
    "/surveys/{}/tiles",
    "/surveys/{}/cloud.ply",
    "/surveys/{}/cloud.laz",
    "/surveys/{}/picture.png",
    "/maps/lobby/cloud.ply",
    "/maps/lobby/cloud.laz",
    "/maps/lobby/manifest",
    "/models",
    "/openapi.json",
)


def test_who_has_an_answer_already_gets_304(client: TestClient, lobby: str) -> None:
    for path in PATHS:
        for coding in (PLAIN, PACKED):
            check_304(client, path.format(lobby), coding)


def check_304(client: TestClient, path: str, coding: dict[str, str]) -> None:
    first = client.get(path, headers=coding)
    assert first.status_code == 200
    etag = first.headers["ETag"]
    for said in (etag, f'"other", {etag}', "*", etag.removeprefix("W/"), f"W/{etag.removeprefix('W/')}"):
        again = client.get(path, headers=coding | {"If-None-Match": said})
        assert (again.status_code, again.content) == (304, b""), said
    assert again.headers["ETag"].removeprefix("W/") == etag.removeprefix("W/")
    assert again.headers["Cache-Control"] == first.headers["Cache-Control"]
    assert again.headers.get("Vary") == first.headers.get("Vary")
    assert "Content-Length" not in again.headers
    assert "Content-Type" not in again.headers
    assert client.head(path, headers=coding | {"If-None-Match": etag}).status_code == 304
    assert (
        client.get(path, headers=coding | {"If-None-Match": '"other"'}).content == first.content
        or "W/" in etag
    )


def test_an_answer_that_has_changed_has_another_etag(
    client: TestClient, catalog: Catalog, lobby: str
) -> None:
    before = {
        path: client.get(path).headers["ETag"] for path in ("/maps", "/maps/lobby", "/maps/lobby/changes")
    }
    add_survey(catalog, [tile(3, 3)])
    for path in ("/maps/lobby/changes",):
        again = client.get(path, headers={"If-None-Match": before[path]})
        assert again.status_code == 200
        assert again.headers["ETag"] != before[path]
    add_map(catalog, "hall")
    assert client.get("/maps", headers={"If-None-Match": before["/maps"]}).status_code == 200


def test_the_etag_is_strong_where_bytes_are_the_same_and_weak_where_they_are_not(
    client: TestClient, lobby: str
) -> None:
    assert client.get("/maps/lobby", headers=PLAIN).headers["ETag"].startswith('"')
    assert client.get(f"/surveys/{lobby}/cloud.ply", headers=PACKED).headers["ETag"].startswith('"')
    assert client.get("/maps/lobby/manifest", headers=PLAIN).headers["ETag"].startswith('"')
    assert client.get("/maps/lobby/manifest", headers=PACKED).headers["ETag"].startswith('W/"')
    changes = client.get("/maps/lobby/changes", headers=PLAIN)  # tells when it was written
    assert "timeStamp" in changes.json()
    assert changes.headers["ETag"].startswith('W/"')


def test_only_a_get_that_went_well_is_known(client: TestClient, lobby: str) -> None:
    assert "ETag" not in client.get("/maps/none").headers
    assert client.get("/maps/none", headers={"If-None-Match": "*"}).status_code == 404
    assert client.delete(f"/surveys/{lobby}", headers={"If-None-Match": "*"}).status_code == 204


def test_a_file_that_was_not_changed_since_is_known(client: TestClient, lobby: str) -> None:
    path = f"/surveys/{lobby}/cloud.ply"
    since = client.get(path).headers["Last-Modified"]
    assert client.get(path, headers={"If-Modified-Since": since}).status_code == 304
    earlier = {"If-Modified-Since": "Mon, 01 Jan 2024 00:00:00 GMT"}
    assert client.get(path, headers=earlier).status_code == 200
    assert client.get(path, headers={"If-Modified-Since": "yesterday"}).status_code == 200
    both = {"If-Modified-Since": since, "If-None-Match": '"other"'}  # the second alone counts
    assert client.get(path, headers=both).status_code == 200


def test_caches_keep_for_ever_what_never_changes_and_ask_again_for_the_rest(
    client: TestClient, lobby: str
) -> None:
    for path in (f"/surveys/{lobby}/cloud.ply", f"/surveys/{lobby}/picture.png"):
        assert client.get(path).headers["Cache-Control"] == "private, max-age=31536000, immutable"
    for path in ("/maps/lobby", "/maps/lobby/cloud.ply", "/maps/lobby/manifest", f"/surveys/{lobby}"):
        assert client.get(path).headers["Cache-Control"] == "private, no-cache"
    assert client.get("/maps/none").headers["Cache-Control"] == "no-store"
    assert client.post("/maps", json={}).headers["Cache-Control"] == "no-store"


@pytest.mark.usefixtures("lobby")
def test_text_is_gzip_for_who_takes_it(client: TestClient) -> None:
    for path in ("/openapi.json", "/maps/lobby/changes", "/maps/lobby/manifest"):
        check_gzip(client.get(path, headers=PLAIN), client.get(path, headers=PACKED))


def check_gzip(plain: Any, packed: Any) -> None:
    assert "Content-Encoding" not in plain.headers
    assert packed.headers["Content-Encoding"] == "gzip"
    assert "Accept-Encoding" in plain.headers["Vary"]
    assert "Accept-Encoding" in packed.headers["Vary"]
    assert "Accept-Ranges" not in packed.headers
    assert packed.json().keys() == plain.json().keys()


def test_clouds_pictures_small_answers_and_parts_are_as_they_are(client: TestClient, lobby: str) -> None:
    for path in (f"/surveys/{lobby}/cloud.ply", f"/surveys/{lobby}/picture.png", "/health/live"):
        assert "Content-Encoding" not in client.get(path, headers=PACKED).headers
    part = client.get("/maps/lobby/manifest", headers=PACKED | {"Range": "bytes=0-9999"})
    assert (part.status_code, part.content) == (206, MANIFEST[:10_000])
    assert "Content-Encoding" not in part.headers


def test_a_problem_is_gzip_too(client: TestClient) -> None:
    asked = {f"unknown{i}": "x" for i in range(19)}
    answer = client.get("/maps", params=asked, headers=PACKED)
    assert answer.status_code == 422
    assert answer.headers["Content-Encoding"] == "gzip"
    assert answer.headers["Content-Type"] == "application/problem+json"


def raw(client: TestClient, path: str, headers: dict[str, str]) -> tuple[bytes, Any]:
    with client.stream("GET", path, headers=headers) as answer:
        return b"".join(answer.iter_raw()), answer.headers


def test_the_length_and_the_digest_are_those_of_what_is_sent(client: TestClient, lobby: str) -> None:
    want = {"Want-Repr-Digest": "sha-256=5", "Want-Content-Digest": "sha-256=1"}
    for coding in (PLAIN, PACKED):
        sent, headers = raw(client, "/openapi.json", coding | want)
        assert int(headers["Content-Length"]) == len(sent)
        assert headers["Repr-Digest"] == headers["Content-Digest"] == sha256(sent)
    assert gzip.decompress(sent)
    assert "Repr-Digest" not in client.get("/openapi.json").headers


def test_a_file_bears_its_digest_also_where_a_part_is_sent(client: TestClient, lobby: str) -> None:
    path = f"/surveys/{lobby}/cloud.ply"
    assert client.get(path).headers["Repr-Digest"] == sha256(CLOUD)
    part = client.get(path, headers={"Range": "bytes=4-7"})
    assert (part.status_code, part.content) == (206, CLOUD[4:8])
    assert part.headers["Repr-Digest"] == sha256(CLOUD)
    longer = client.get(path, headers={"Want-Repr-Digest": "sha-256=1, sha-512=9"}).headers["Repr-Digest"]
    assert longer == f"sha-512=:{base64.b64encode(hashlib.sha512(CLOUD).digest()).decode()}:"
    _, headers = raw(client, "/maps/lobby/manifest", PACKED)  # larger than a piece: packed as it goes
    assert "Repr-Digest" not in headers


def test_no_bytes_of_a_file_are_a_problem(client: TestClient, lobby: str) -> None:
    path = f"/surveys/{lobby}/cloud.ply"
    for asked in ("bytes=9999999-", "bytes=9-3", "bytes=-0"):
        answer = client.get(path, headers={"Range": asked})
        assert answer.status_code == 416, asked
        assert answer.json()["type"] == "urn:spicd:problem:range_not_satisfiable"
        assert answer.headers["Content-Type"] == "application/problem+json"
        assert answer.headers["Content-Range"] == f"bytes */{len(CLOUD)}"
        assert answer.headers["Cache-Control"] == "no-store"
        head = client.head(path, headers={"Range": asked})
        assert (head.status_code, head.content) == (416, b"")
    for ignored in ("lines=1-2", "bytes", "bytes=", "bytes=a-b", "bytes=1-2, x", "bytes=" + 30 * "9" + "-"):
        assert client.get(path, headers={"Range": ignored}).status_code == 200, ignored


def test_a_range_is_taken_of_the_same_file_alone(client: TestClient, lobby: str) -> None:
    path = f"/surveys/{lobby}/cloud.ply"
    etag = client.get(path).headers["ETag"]
    same = client.get(path, headers={"Range": "bytes=0-3", "If-Range": etag})
    assert (same.status_code, same.content) == (206, b"ply\n")
    assert client.get(path, headers={"Range": "bytes=0-3", "If-Range": '"other"'}).status_code == 200


def app_with_streams() -> FastAPI:
    app = FastAPI()

    def lines() -> Iterator[bytes]:
        for number in range(3000):
            yield b"%d,changed\n" % number

    @app.get("/table")
    def table() -> StreamingResponse:
        return StreamingResponse(lines(), media_type="text/csv")

    @app.get("/events")
    def events() -> StreamingResponse:
        return StreamingResponse(lines(), media_type="text/event-stream")

    @app.get("/coded")
    def coded() -> Response:
        headers = {"Content-Encoding": "gzip"}
        return Response(gzip.compress(b"x" * 5000), media_type="text/plain", headers=headers)

    app.add_middleware(RepresentationMiddleware)
    return app


def test_a_stream_is_packed_as_it_goes_and_events_never_are() -> None:
    client = TestClient(app_with_streams())
    sent, headers = raw(client, "/table", PACKED)
    assert headers["Content-Encoding"] == "gzip"
    assert "Content-Length" not in headers
    assert gzip.decompress(sent).count(b"\n") == 3000
    _, headers = raw(client, "/events", PACKED)
    assert "Content-Encoding" not in headers
    assert "ETag" not in headers


def test_events_are_passed_on_at_once() -> None:
    """Each message of the app is sent before the next one, the headers first: nobody waits for a piece to fill."""
    sent: list[str] = []
    seen: list[list[str]] = []

    async def app(_scope: Any, _receive: Any, send: Any) -> None:
        headers = [(b"content-type", b"text/event-stream; charset=utf-8")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        seen.append(list(sent))
        await send({"type": "http.response.body", "body": b"id: 1\n\n", "more_body": True})
        seen.append(list(sent))

    async def note(message: Any) -> None:
        sent.append(message["type"])

    async def nothing() -> Any:
        raise AssertionError("nobody asks")

    scope: Any = {"type": "http", "method": "GET", "headers": [(b"accept-encoding", b"gzip")]}
    anyio.run(RepresentationMiddleware(app).__call__, scope, nothing, note)
    assert seen == [["http.response.start"], ["http.response.start", "http.response.body"]]


def test_what_is_coded_already_stays_as_it_is() -> None:
    client = TestClient(app_with_streams())
    assert client.get("/coded", headers=PACKED).text == "x" * 5000


def test_a_file_of_a_store_elsewhere_has_an_etag_too(tmp_path: Path) -> None:
    settings = settings_in(tmp_path).model_copy(update={"blob_url": "memory:///"})
    with running(settings, RememberingQueue()) as client:
        catalog = catalog_of(client)
        key = blob_keys.map_cloud(add_map(catalog))
        catalog.blobs.put_bytes(key, CLOUD)
        assert not catalog.blobs.is_local
        path = "/maps/lobby/cloud.ply"
        first, head = client.get(path), client.head(path)
        assert first.content == CLOUD
        etag = first.headers["ETag"]
        assert (head.status_code, head.content, head.headers["ETag"]) == (200, b"", etag)
        assert head.headers["Content-Length"] == str(len(CLOUD))
        again = client.get(path, headers={"If-None-Match": etag})
        assert (again.status_code, again.content) == (304, b"")
        catalog.blobs.put_bytes(key, CLOUD + b"!")
        assert client.get(path, headers={"If-None-Match": etag}).content == CLOUD + b"!"
