"""Content codings: a gzipped body is the body, under the same limits; an answer is gzip for who takes it."""

from __future__ import annotations

import gzip
import json
import tracemalloc
import zlib
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from starlette.datastructures import Headers

from service.api.http.reading.bodies import MAX_JSON_BYTES
from service.api.http.reading.codings import PIECE, accepts_gzip, coding_of, shrinks
from service.catalog.catalog import Catalog
from service.errors import BrokenRequest
from service.settings import Settings
from tests.support.samples import add_map, ply

RAW = {"Content-Type": "application/octet-stream"}
GZIP = {"Content-Encoding": "gzip"}
JSON = {"Content-Type": "application/json"}


def incoming(settings: Settings) -> list[Path]:
    folder = settings.data_dir / "incoming"
    return list(folder.iterdir()) if folder.exists() else []


@pytest.mark.parametrize("coding", ["gzip", "GZIP", "x-gzip", "gzip, identity"])
def test_a_gzipped_scan_is_the_scan_that_it_holds(client: TestClient, catalog: Catalog, coding: str) -> None:
    packed = client.post("/scans", content=gzip.compress(ply()), headers=RAW | {"Content-Encoding": coding})
    assert packed.status_code == 201, packed.text
    assert packed.json()["size"] == len(ply())
    plain = client.post("/scans", content=ply(), headers=RAW)
    assert plain.status_code == 200
    assert plain.json() == packed.json()
    assert catalog.blobs.get_bytes(catalog.scans.get(plain.json()["scan_id"]).key) == ply()


def test_a_gzipped_form_and_gzipped_json_are_read(client: TestClient, catalog: Catalog) -> None:
    request = client.build_request(
        "POST", "/scans", data={"device_id": "r7"}, files={"file": ("a.ply", ply())}
    )
    body = gzip.compress(request.read())
    form = client.post(
        "/scans", content=body, headers={**GZIP, "Content-Type": request.headers["content-type"]}
    )
    assert (form.status_code, form.json()["device_id"]) == (201, "r7")
    asked = gzip.compress(json.dumps({"id": "lobby", "scan_ids": [form.json()["scan_id"]]}).encode())
    assert client.post("/maps", content=asked, headers=GZIP | JSON).status_code == 202
    assert catalog.maps.get("lobby").map_id == "lobby"


def test_members_of_gzip_one_behind_another_are_one_body(client: TestClient) -> None:
    content = ply()
    members = gzip.compress(content[:7]) + gzip.compress(content[7:])
    answer = client.post("/scans", content=members, headers=RAW | GZIP)
    assert (answer.status_code, answer.json()["size"]) == (201, len(content))


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"no gzip at all",
        gzip.compress(ply())[:-4],
        gzip.compress(ply())[:-8] + bytes(8),
        gzip.compress(ply()) + b"behind",
        zlib.compress(ply()),
    ],
    ids=["nothing", "no gzip", "cut off", "wrong sum", "more behind", "zlib"],  # a gzip bears its time
)
def test_what_is_no_whole_gzip_is_refused_and_not_kept(
    client: TestClient, catalog: Catalog, settings: Settings, body: bytes
) -> None:
    answer = client.post("/scans", content=body, headers=RAW | GZIP)
    assert answer.status_code == 400
    assert answer.json()["type"] == "urn:spicd:problem:broken_request"
    assert catalog.scans.page().items == []
    assert incoming(settings) == []


@pytest.mark.parametrize("coding", ["br", "deflate", "gzip, gzip", "gzip, br", "zstd"])
def test_another_coding_is_a_415_that_says_which_are_taken(client: TestClient, coding: str) -> None:
    answer = client.post("/scans", content=ply(), headers=RAW | {"Content-Encoding": coding})
    assert answer.status_code == 415
    assert answer.json()["type"] == "urn:spicd:problem:wrong_encoding"
    assert answer.headers["Accept-Encoding"] == "gzip, identity"


def test_a_bomb_is_too_large_and_leaves_nothing(client: TestClient, settings: Settings) -> None:
    bomb = gzip.compress(ply() + bytes(60_000_000))
    assert len(bomb) < 100_000 < settings.max_upload_bytes
    answer = client.post("/scans", content=bomb, headers=RAW | GZIP)
    assert answer.status_code == 413
    assert str(settings.max_upload_bytes) in answer.json()["detail"]
    assert incoming(settings) == []
    text = gzip.compress(b'{"name": "' + bytes(MAX_JSON_BYTES) + b'"}')
    assert client.post("/maps", content=text, headers=JSON | GZIP).status_code == 413


def test_a_bomb_is_decoded_in_bounded_memory() -> None:
    bomb = gzip.compress(bytes(200_000_000))
    coding = coding_of(Headers(GZIP))
    tracemalloc.start()
    try:
        total = sum(len(part) for part in coding.decoded(bomb))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    coding.finish()
    assert total == 200_000_000
    assert peak < 8 * PIECE


def test_a_piece_that_is_cut_anywhere_gives_the_same_bytes() -> None:
    whole = gzip.compress(b"ab") + gzip.compress(b"cdef" * 100)
    for cut in range(len(whole) + 1):
        coding = coding_of(Headers(GZIP))
        told = b"".join([*coding.decoded(whole[:cut]), *coding.decoded(whole[cut:])])
        coding.finish()
        assert told == b"ab" + b"cdef" * 100
    cut_short = coding_of(Headers(GZIP))
    list(cut_short.decoded(whole[:-1]))
    with pytest.raises(BrokenRequest, match="ends within"):
        cut_short.finish()


@pytest.mark.parametrize(
    ("said", "may"),
    [
        (None, False),
        ("gzip", True),
        ("br, GZIP;q=0.5", True),
        ("gzip;q=0", False),
        ("gzip; q=0.000, *", False),
        ("*", True),
        ("*;q=0", False),
        ("identity", False),
        ("gzip;q=much", False),
    ],
)
def test_who_says_that_it_takes_gzip_gets_it(said: str | None, may: bool) -> None:
    assert accepts_gzip(Headers({} if said is None else {"Accept-Encoding": said})) is may


@pytest.mark.parametrize(
    ("media_type", "is_text"),
    [
        ("application/json", True),
        ("application/geo+json", True),
        ("application/problem+json", True),
        ("application/vnd.ogc.fg+json; charset=utf-8", True),
        ("text/csv; charset=utf-8", True),
        ("text/html", True),
        ("text/event-stream", False),
        ("application/octet-stream", False),
        ("image/png", False),
        ("", False),
    ],
)
def test_text_is_worth_coding(media_type: str, is_text: bool) -> None:
    assert shrinks(media_type) is is_text


def test_a_part_of_a_body_is_refused(client: TestClient, catalog: Catalog) -> None:
    part = {"Content-Range": "bytes 0-9/100"}
    for answer in (
        client.post("/scans", content=ply(), headers=RAW | part),
        client.post("/scans", files={"file": ("a.ply", ply())}, headers=part),
    ):
        assert answer.status_code == 400
        assert answer.json()["type"] == "urn:spicd:problem:broken_request"
    add_map(catalog)
    anchor = {"longitude": 13.4, "latitude": 52.5, "height": 70, "heading": 90}
    assert client.put("/maps/lobby/anchor", json=anchor, headers=part).status_code == 400
    assert catalog.maps.get("lobby").anchor is None
    assert len(catalog.scans.page().items) == 1  # that of the map
