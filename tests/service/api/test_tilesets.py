"""Tilesets as viewers fetch them: the document, its contents by their addresses, ranges, caches, keys."""

from __future__ import annotations

import hashlib
import json
import math
import struct
import tracemalloc
from pathlib import Path
from urllib.parse import urljoin

import numpy as np
import pytest
from fastapi.testclient import TestClient

from service.api.gis import geodesy
from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.catalog.files.tilesets import MOST_BYTES, address
from service.catalog.records import Tileset
from service.settings import Settings
from tests.support.samples import (
    BOUNDS,
    MODEL,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    add_version,
    catalog_of,
    running,
    tile,
)

ANCHOR = {"longitude": 13.4, "latitude": 52.5, "height": 76.2, "heading": 30.0}


def glb(filling: int, size: int = 64) -> bytes:
    """Bytes that say of themselves that they are a GLB of so many bytes."""
    return struct.pack("<4sII", b"glTF", 2, size) + bytes([filling]) * (size - 12)


CONTENTS = glb(1) + glb(2, 96) + glb(3)


def size_of(contents: bytes = CONTENTS) -> Tileset:
    return Tileset(n_points=30, contents=3, bytes=len(contents), sha256=hashlib.sha256(contents).hexdigest())


def put(catalog: Catalog, *, document: str, contents: str, told: Tileset) -> list[str]:
    """Keep a tileset of three contents; their addresses."""
    places = ((0, 64), (64, 96), (160, 64))
    uris = [address(told.sha256, offset, length) for offset, length in places]
    tiles = [{"content": {"uri": uri}} for uri in uris]
    text = json.dumps({"asset": {"version": "1.1"}, "root": tiles[0] | {"children": tiles[1:]}})
    catalog.blobs.put_bytes(contents, CONTENTS)
    catalog.blobs.put_bytes(document, text.encode())
    return uris


def build(catalog: Catalog, job_id: str, *, told: Tileset | None = None) -> list[str]:
    """Give a version that was built a tileset; the addresses of its contents."""
    told = told or size_of()
    catalog.versions.save_result(job_id, outcomes=[], bounds=BOUNDS, counts={"points": 30}, tileset=told)
    return put(
        catalog,
        told=told,
        document=blob_keys.map_tileset(job_id),
        contents=blob_keys.map_tileset_contents(job_id),
    )


@pytest.fixture
def uris(catalog: Catalog) -> list[str]:
    """A map with a tileset; the paths of its contents."""
    return [f"/maps/lobby/versions/1/{uri}" for uri in build(catalog, add_map(catalog))]


def links(document: dict[str, object]) -> list[str]:
    return [link["href"] for link in document["links"] if link["rel"] == "tileset"]  # type: ignore[attr-defined]


def test_a_map_and_its_version_link_to_their_tileset_and_say_how_large_it_is(
    client: TestClient, uris: list[str]
) -> None:
    for path in ("/maps/lobby", "/maps/lobby/versions/1"):
        document = client.get(path).json()
        assert links(document) == [f"{path}/tileset.json"]
        assert document["tileset"] == size_of().model_dump()
    (listed,) = client.get("/maps").json()["maps"]
    assert listed["tileset"]["n_points"] == 30


def test_a_viewer_comes_from_the_map_to_every_content_by_relative_addresses(
    client: TestClient, uris: list[str]
) -> None:
    document = client.get("/maps/lobby/tileset.json").json()
    assert document["asset"]["version"] == "1.1"
    assert document["root"]["refine"] == "ADD"
    assert "transform" not in document["root"]
    box = document["root"]["boundingVolume"]["box"]
    for axis, half in enumerate((box[3], box[7], box[11])):
        assert box[axis] - half <= BOUNDS.min[axis]
        assert box[axis] + half >= BOUNDS.max[axis]
    inner = urljoin("/maps/lobby/tileset.json", document["root"]["content"]["uri"])
    assert inner == "/maps/lobby/versions/1/tileset.json"
    root = client.get(inner).json()["root"]
    tiles = [root, *root["children"]]
    assert [urljoin(inner, one["content"]["uri"]) for one in tiles] == uris
    got = [client.get(uri) for uri in uris]
    assert b"".join(answer.content for answer in got) == CONTENTS
    assert {answer.headers["Content-Type"] for answer in got} == {"model/gltf-binary"}


def test_the_map_shows_the_tileset_of_the_version_in_use(client: TestClient, uris: list[str]) -> None:
    catalog = catalog_of(client)
    before = client.get("/maps/lobby/tileset.json")
    assert before.headers["Cache-Control"] == "private, no-cache"
    build(catalog, add_version(catalog))
    after = client.get("/maps/lobby/tileset.json")
    assert after.json()["root"]["content"]["uri"] == "versions/2/tileset.json"
    assert after.headers["ETag"] != before.headers["ETag"]
    assert client.get(uris[0]).status_code == 200  # of version 1, which is still there


@pytest.mark.parametrize("stored", ["folder", "elsewhere"])
def test_a_content_is_cached_for_ever_and_its_ranges_and_headers_are_right(
    settings: Settings,
    queue: RememberingQueue,
    stored: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)  # where samples write a file aside for a store that has no folder
    url = None if stored == "folder" else "memory:///"
    with running(settings.model_copy(update={"blob_url": url}), queue) as client:
        catalog = catalog_of(client)
        path = f"/maps/lobby/versions/1/{build(catalog, add_map(catalog))[1]}"
        whole = client.get(path)
        assert whole.content == glb(2, 96)
        assert whole.headers["Cache-Control"] == "private, max-age=31536000, immutable"
        assert whole.headers["Accept-Ranges"] == "bytes"
        head = client.head(path)
        assert (head.status_code, head.content, head.headers["Content-Length"]) == (200, b"", "96")
        known = client.get(path, headers={"If-None-Match": whole.headers["ETag"]})
        assert (known.status_code, known.content) == (304, b"")
        assert known.headers["Cache-Control"] == whole.headers["Cache-Control"]
        for asked, told, content in (
            ("bytes=0-11", "bytes 0-11/96", glb(2, 96)[:12]),
            ("bytes=90-", "bytes 90-95/96", b"\2" * 6),
            ("bytes=-4", "bytes 92-95/96", b"\2" * 4),
            ("bytes=80-999", "bytes 80-95/96", b"\2" * 16),
            ("bytes=-999", "bytes 0-95/96", glb(2, 96)),
        ):
            part = client.get(path, headers={"Range": asked})
            assert (part.status_code, part.headers["Content-Range"], part.content) == (206, told, content)
            assert part.headers["ETag"] == whole.headers["ETag"]
            assert part.headers["Content-Length"] == str(len(content))
        for asked in ("bytes=96-", "bytes=5-3", "bytes=-0"):
            refused = client.get(path, headers={"Range": asked})
            assert (refused.status_code, refused.headers["Content-Range"]) == (416, "bytes */96"), asked
        for asked in ("bytes=0-1,3-4", "rows=0-1", "bytes=-", "bytes=x-"):  # may be ignored, or must
            assert client.get(path, headers={"Range": asked}).content == whole.content
        stale = {"Range": "bytes=0-3", "If-Range": '"another"'}
        assert client.get(path, headers=stale).status_code == 200
        fresh = {"Range": "bytes=0-3", "If-Range": whole.headers["ETag"]}
        assert client.get(path, headers=fresh).content == b"glTF"


def test_the_document_is_asked_for_again_and_answered_with_304(client: TestClient, uris: list[str]) -> None:
    for path in ("/maps/lobby/tileset.json", "/maps/lobby/versions/1/tileset.json"):
        first = client.get(path)
        assert first.headers["Cache-Control"] == "private, no-cache"
        assert client.get(path, headers={"If-None-Match": first.headers["ETag"]}).status_code == 304
        assert client.head(path).status_code == 200


def test_another_site_that_is_allowed_may_read_it_and_a_range_of_it(
    settings: Settings, queue: RememberingQueue
) -> None:
    origin = "https://dash.example.org"
    with running(settings.model_copy(update={"allowed_origins": origin}), queue) as client:
        catalog = catalog_of(client)
        path = f"/maps/lobby/versions/1/{build(catalog, add_map(catalog))[0]}"
        for asked in ({}, {"Range": "bytes=0-3"}):
            answer = client.get(path, headers={"Origin": origin, **asked})
            assert answer.headers["Access-Control-Allow-Origin"] == origin


@pytest.mark.parametrize(
    "name",
    [
        "{}-1-64.glb",  # within the first content
        "{}-0-63.glb",
        "{}-64-64.glb",  # of the second, which is longer
        "{}-160-65.glb",
        "{}-224-64.glb",  # behind the end
        "{}-999999999999999-64.glb",
        "{}-0-99999999.glb",  # more than a content has
        "0123456789abcdef-0-64.glb",
        "{}-0-64.bin",
        "{}0-0-64.glb",
        "0-64.glb",
        "..%2F..%2Fcloud.ply",
    ],
)
def test_an_address_that_the_document_does_not_name_is_no_content(
    client: TestClient, catalog: Catalog, name: str
) -> None:
    build(catalog, add_map(catalog))
    answer = client.get(f"/maps/lobby/versions/1/tileset/{name.format(size_of().sha256[:16])}")
    assert answer.status_code == 404


def test_another_map_of_the_same_id_has_other_addresses(client: TestClient, uris: list[str]) -> None:
    """So that what a browser keeps for ever is never shown for another map."""
    catalog = catalog_of(client)
    client.delete("/maps/lobby")
    assert client.get(uris[0]).status_code == 404
    other = size_of(b"other contents")
    again = [f"/maps/lobby/versions/1/{uri}" for uri in build(catalog, add_map(catalog), told=other)]
    assert not set(again) & set(uris)
    assert client.get(uris[0]).status_code == 404
    assert client.get(again[0]).status_code == 200


def test_what_was_built_without_a_tileset_says_so(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    document = client.get("/maps/lobby").json()
    assert links(document) == []
    assert document["tileset"] is None
    for path in ("/maps/lobby/tileset.json", "/maps/lobby/versions/1/tileset.json"):
        answer = client.get(path)
        assert answer.status_code == 404
        assert "has no tileset" in answer.json()["detail"]


def test_a_map_that_is_not_ready_has_none_yet(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog, ready=False)
    for path in ("", "/versions/1"):
        assert client.get(f"/maps/lobby{path}/tileset.json").status_code == 409
    assert client.get("/maps/lobby/versions/1/tileset/0123456789abcdef-0-64.glb").status_code == 409


@pytest.mark.parametrize("crs", ["EPSG:4978", "http://www.opengis.net/def/crs/EPSG/0/4978"])
def test_a_map_with_an_anchor_lies_on_the_earth_where_that_is_asked_for(
    client: TestClient, uris: list[str], crs: str
) -> None:
    client.put("/maps/lobby/anchor", json=ANCHOR)
    assert "transform" not in client.get("/maps/lobby/tileset.json").json()["root"]
    document = client.get("/maps/lobby/tileset.json", params={"crs": crs}).json()
    matrix = np.array(document["root"]["transform"]).reshape(4, 4).T
    record = catalog_of(client).maps.get("lobby")
    assert record.anchor is not None
    convert = geodesy.to_wgs84(record.anchor)
    for point in ((0.0, 0.0, 0.0), (12.0, -7.0, 3.0), (-200.0, 90.0, 0.5)):
        longitude, latitude, height = convert(point)
        expected = geodesy.to_ecef(math.radians(longitude), math.radians(latitude), height)
        assert (matrix @ [*point, 1])[:3] == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)


def test_what_a_tileset_names_takes_the_parameter_that_cesium_hands_on(
    client: TestClient, uris: list[str]
) -> None:
    for path in ("/maps/lobby/versions/1/tileset.json", *uris):
        plain = client.get(path)
        handed_on = client.get(f"{path}?crs=EPSG%3A4978")
        assert plain.status_code == handed_on.status_code == 200
        assert handed_on.content == plain.content


def test_nobody_can_put_a_map_without_an_anchor_on_the_earth(client: TestClient, uris: list[str]) -> None:
    answer = client.get("/maps/lobby/tileset.json?crs=EPSG:4978")
    assert answer.status_code == 422
    assert "put an anchor" in answer.json()["errors"][0]["detail"]
    assert client.get("/maps/lobby/tileset.json?crs=EPSG:3857").status_code == 422


def test_a_large_survey_has_a_tileset_and_a_small_one_has_none(client: TestClient, uris: list[str]) -> None:
    catalog = catalog_of(client)
    small, _ = add_survey(catalog, [tile(0, 0)])
    assert client.get(f"/surveys/{small}/tileset.json").status_code == 404
    assert links(client.get(f"/surveys/{small}").json()) == []
    scan = add_scan(catalog, "later")
    survey, job = catalog.surveys.create("lobby", scan_ids=[scan.scan_id], model=MODEL)
    catalog.surveys.save_result(survey.survey_id, tiles=[tile(0, 0)], threshold=0.5, tileset=size_of())
    catalog.jobs.succeed(job.job_id)
    own = put(
        catalog,
        told=size_of(),
        document=blob_keys.survey_tileset(survey.survey_id),
        contents=blob_keys.survey_tileset_contents(survey.survey_id),
    )
    here = f"/surveys/{survey.survey_id}"
    document = client.get(here).json()
    assert links(document) == [f"{here}/tileset.json"]
    assert document["tileset"]["n_points"] == 30
    answer = client.get(f"{here}/tileset.json")
    assert answer.headers["Cache-Control"].endswith("immutable")
    assert client.get(f"{here}/{own[2]}").content == glb(3)
    assert client.get(f"{here}/tileset/0123456789abcdef-0-64.glb").status_code == 404


def test_the_api_reads_one_content_into_memory_and_not_the_tileset(
    client: TestClient, catalog: Catalog
) -> None:
    job_id = add_map(catalog)
    _, uri, _ = build(catalog, job_id)
    many = 40 * MOST_BYTES // 16
    path = catalog.blobs.path(blob_keys.map_tileset_contents(job_id))
    assert path is not None
    with path.open("r+b") as file:
        file.truncate(many)  # 40 MB, most of them a hole
    tracemalloc.start()
    try:
        assert client.get(f"/maps/lobby/versions/1/{uri}").content == glb(2, 96)
        assert tracemalloc.get_traced_memory()[1] < many / 4
    finally:
        tracemalloc.stop()
