"""Digests (RFC 9530): what a request says of its body is held against it, and a wrong body is not kept."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from starlette.datastructures import Headers

from service.api.http.reading.digests import digest_of, wanted
from service.catalog.catalog import Catalog
from service.settings import Settings
from tests.support.samples import ply

RAW = {"Content-Type": "application/octet-stream"}
NAMES = ["Content-Digest", "Repr-Digest"]


def digest(data: bytes, algorithm: str = "sha-256") -> str:
    value = base64.b64encode(hashlib.new(algorithm.replace("-", ""), data).digest()).decode()
    return f"{algorithm}=:{value}:"


def incoming(settings: Settings) -> list[Path]:
    folder = settings.data_dir / "incoming"
    return list(folder.iterdir()) if folder.exists() else []


def test_the_digest_of_the_standards_example() -> None:
    """RFC 9530, Appendix B.1."""
    assert digest_of("sha-256", b'{"hello": "world"}\n') == (
        "sha-256=:RK/0qy18MlBSVnWgjwz6lZEWjP/lF5HF9bvEF8FabDg=:"
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("algorithm", ["sha-256", "sha-512"])
def test_a_body_that_is_what_its_digest_says_is_kept(client: TestClient, name: str, algorithm: str) -> None:
    answer = client.post("/scans", content=ply(), headers=RAW | {name: digest(ply(), algorithm)})
    assert answer.status_code == 201


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("algorithm", ["sha-256", "sha-512"])
def test_a_body_that_is_not_is_refused_and_not_kept(
    client: TestClient, catalog: Catalog, settings: Settings, name: str, algorithm: str
) -> None:
    answer = client.post("/scans", content=ply(), headers=RAW | {name: digest(ply("other"), algorithm)})
    assert answer.status_code == 400
    assert answer.json()["type"] == "urn:spicd:problem:wrong_digest"
    assert digest(ply(), algorithm).partition("=")[2] in answer.json()["detail"]
    assert catalog.scans.page().items == []
    assert incoming(settings) == []


def test_of_several_digests_each_has_to_be_right(client: TestClient) -> None:
    right, wrong = digest(ply()), digest(ply("other"), "sha-512")
    both = client.post("/scans", content=ply(), headers=RAW | {"Repr-Digest": f"{right}, {wrong}"})
    assert both.status_code == 400
    split = RAW | {"Repr-Digest": right, "Content-Digest": wrong}
    assert client.post("/scans", content=ply(), headers=split).status_code == 400


def test_a_form_and_json_have_digests_too(client: TestClient, catalog: Catalog) -> None:
    request = client.build_request("POST", "/scans", files={"file": ("a.ply", ply())})
    body, headers = request.read(), {"Content-Type": request.headers["content-type"]}
    wrong = client.post("/scans", content=body, headers=headers | {"Content-Digest": digest(b"")})
    assert (wrong.status_code, catalog.scans.page().items) == (400, [])
    right = client.post("/scans", content=body, headers=headers | {"Content-Digest": digest(body)})
    assert right.status_code == 201
    asked = json.dumps({"scan_ids": [right.json()["scan_id"]]}).encode()
    headers = {"Content-Type": "application/json"}
    wrong = client.post("/maps", content=asked, headers=headers | {"Repr-Digest": digest(b"")})
    assert (wrong.status_code, catalog.maps.page().items) == (400, [])
    assert (
        client.post("/maps", content=asked, headers=headers | {"Repr-Digest": digest(asked)}).status_code
        == 202
    )


def test_the_digest_of_a_gzipped_body_is_that_of_its_gzip(client: TestClient) -> None:
    packed = gzip.compress(ply())
    headers = RAW | {"Content-Encoding": "gzip"}
    assert (
        client.post("/scans", content=packed, headers=headers | {"Repr-Digest": digest(ply())}).status_code
        == 400
    )
    assert (
        client.post("/scans", content=packed, headers=headers | {"Repr-Digest": digest(packed)}).status_code
        == 201
    )


@pytest.mark.parametrize(
    "value",
    [
        "sha-256=deadbeef",
        "sha-256=:AAAA:",
        "sha-256",
        'sha-256="AAAA"',
        "sha-256=:A:A:",
        ":AAAA:",
        "sha-256=:é:",
    ],
)
def test_a_digest_that_cannot_be_read_is_refused(client: TestClient, catalog: Catalog, value: str) -> None:
    header = [("content-type", RAW["Content-Type"]), ("content-digest", value.encode("latin-1"))]
    answer = client.post("/scans", content=ply(), headers=header)
    assert answer.status_code == 400
    assert answer.json()["type"] == "urn:spicd:problem:broken_request"
    assert catalog.scans.page().items == []


@pytest.mark.parametrize("value", ["md5=:AAAA:", "unixsum=:AA==:;a=1, new=token", ""])
def test_algorithms_that_are_not_known_are_ignored(client: TestClient, value: str) -> None:
    assert client.post("/scans", content=ply(), headers=RAW | {"Content-Digest": value}).status_code == 201


@pytest.mark.parametrize(
    ("said", "algorithm"),
    [
        ("sha-256=1", "sha-256"),
        ("sha-256=1, sha-512=3", "sha-512"),
        ("sha-512=0, sha-256=10", "sha-256"),
        ("sha-256=0", None),
        ("md5=10", None),
        ("sha-256=yes", None),
        ("", None),
        ("=", None),
    ],
)
def test_a_wish_for_a_digest_is_weighed(said: str, algorithm: str | None) -> None:
    assert wanted(Headers({"Want-Repr-Digest": said}), "Want-Repr-Digest") == algorithm
