"""/scans: streamed in, hashed, known by content, never parsed."""

from __future__ import annotations

import hashlib
import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.errors import QueueUnavailable
from service.settings import Settings
from tests.support.samples import IDENTITY, RememberingQueue, add_map, ply, running

RAW = {"Content-Type": "application/octet-stream"}
POSE = [[0, -1, 0, 2.5], [1, 0, 0, 0], [0, 0, 1, 0.35], [0, 0, 0, 1]]


def incoming(settings: Settings) -> list[Path]:
    folder = settings.data_dir / "incoming"
    return list(folder.iterdir()) if folder.exists() else []


def test_a_raw_body_becomes_a_scan_with_its_bytes(
    client: TestClient, catalog: Catalog, settings: Settings
) -> None:
    sent = {"filename": "hall.ply", "captured_at": "2026-03-01T13:00:00+01:00", "pose": json.dumps(POSE)}
    answer = client.post("/scans", content=ply(), headers=RAW, params=sent)
    scan = answer.json()
    assert answer.status_code == 201
    assert answer.headers["location"] == f"/scans/{scan['scan_id']}"
    assert scan["sha256"] == hashlib.sha256(ply()).hexdigest()
    assert (scan["filename"], scan["format"], scan["size"]) == ("hall.ply", "ply", len(ply()))
    assert scan["captured_at"] == "2026-03-01T12:00:00Z"
    assert scan["pose"] == POSE
    assert "key" not in scan
    assert catalog.blobs.get_bytes(catalog.scans.get(scan["scan_id"]).key) == ply()
    assert incoming(settings) == []
    assert client.get(answer.headers["location"]).json() == scan


def test_a_form_brings_the_same_scan_with_its_fields(client: TestClient) -> None:
    form = {"device_id": "robot-7", "captured_at": "2026-03-01T12:00:00Z", "pose": json.dumps(POSE)}
    answer = client.post("/scans", data=form, files={"file": ("flur.ply", ply())})
    scan = answer.json()
    assert answer.status_code == 201
    assert (scan["filename"], scan["device_id"], scan["pose"]) == ("flur.ply", "robot-7", POSE)
    raw = client.post("/scans", content=ply(), headers=RAW, params={"device_id": "robot-7"})
    assert raw.status_code == 200
    assert raw.json() == scan


def test_the_same_bytes_twice_are_one_scan_and_from_two_devices_two(client: TestClient) -> None:
    ids = []
    for device, status in (("a", 201), ("a", 200), ("b", 201)):
        answer = client.post("/scans", content=ply(), headers=RAW, params={"device_id": device})
        assert answer.status_code == status
        ids.append(answer.json()["scan_id"])
    assert ids[0] == ids[1] != ids[2]


@pytest.mark.parametrize(
    ("head", "known"),
    [
        (b"ply\r\nformat ascii 1.0\r\n", "ply"),
        (b"# .PCD v0.7 - Point Cloud Data file format\n", "pcd"),
        (b"VERSION 0.7\nFIELDS x y z\n", "pcd"),
        (b"#.PCD\n", "pcd"),
        (b"ASTM-E57" + bytes(40), "e57"),
        (b"LASF" + bytes(100) + b"\x03" + bytes(122), "las"),
        (b"LASF" + bytes(100) + b"\x83" + bytes(122), "laz"),
        (b"LASF", "las"),
    ],
)
def test_the_first_bytes_tell_the_format(client: TestClient, head: bytes, known: str) -> None:
    assert client.post("/scans", content=head, headers=RAW).json()["format"] == known


@pytest.mark.parametrize("body", [b"", b"plywood", b"\x89PNG\r\n", b"\x00" * 100, b"LAS", b"ASTM-E5"])
def test_another_file_is_refused_by_name_and_leaves_nothing(
    client: TestClient, catalog: Catalog, settings: Settings, body: Any
) -> None:
    answer = client.post("/scans", content=body, headers=RAW, params={"filename": "hall.png"})
    assert answer.status_code == 422
    assert answer.json()["type"] == "urn:spicd:problem:scan_unreadable"
    assert answer.json()["detail"].startswith("hall.png: ")
    form = client.post("/scans", files={"file": ("hall.png", body)})
    assert (form.status_code, form.json()) == (422, answer.json())
    assert incoming(settings) == []
    assert catalog.scans.page().items == []


@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("as_form", [True, False])
def test_a_body_over_the_limit_is_refused_and_leaves_nothing(
    client: TestClient, catalog: Catalog, settings: Settings, declared: bool, as_form: bool
) -> None:
    body, headers = ply() + bytes(settings.max_upload_bytes), RAW
    if as_form:
        request = client.build_request("POST", "/scans", files={"file": ("hall.ply", body)})
        body, headers = request.read(), {"Content-Type": request.headers["content-type"]}
    content = body if declared else (body[n : n + 65536] for n in range(0, len(body), 65536))
    answer = client.post("/scans", content=content, headers=headers)
    assert answer.status_code == 413
    assert str(settings.max_upload_bytes) in answer.json()["detail"]
    assert incoming(settings) == []
    assert catalog.scans.page().items == []


@pytest.mark.parametrize("cut", [30, 120, 180])
def test_a_form_that_ends_early_leaves_nothing(
    client: TestClient, catalog: Catalog, settings: Settings, cut: int
) -> None:
    request = client.build_request("POST", "/scans", files={"file": ("hall.ply", ply())})
    headers = {"Content-Type": request.headers["content-type"]}
    answer = client.post("/scans", content=request.read()[:cut], headers=headers)
    assert answer.status_code == 422
    assert answer.json()["type"] == "urn:spicd:problem:bad_request"
    assert incoming(settings) == []
    assert catalog.scans.page().items == []


@pytest.mark.parametrize(
    ("pose", "told"),
    [
        ("[[1,0,0,0],[0,1,0,0],[0,0,1,0]]", "pose"),
        ("no json", "not JSON"),
        (json.dumps([[2, 0, 0, 0], *IDENTITY[1:]]), "rigid"),
        (json.dumps([[-1, 0, 0, 0], *IDENTITY[1:]]), "mirrors"),
        (json.dumps([*IDENTITY[:3], [1, 0, 0, 1]]), "last row"),
        (json.dumps([[1, 0, 0, 8000], [0, 1, 0, -7000], *IDENTITY[2:]]), "shifts by 10630 m"),
        ("[[NaN,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]", "finite"),
    ],
)
def test_a_pose_that_is_not_rigid_or_far_away_is_refused_with_its_place(
    client: TestClient, pose: Any, told: str
) -> None:
    for answer in (
        client.post("/scans", content=ply(), headers=RAW, params={"pose": pose}),
        client.post("/scans", data={"pose": pose}, files={"file": ("hall.ply", ply())}),
    ):
        assert answer.status_code == 422
        assert told in answer.json()["detail"]
        assert ".pose" in answer.json()["errors"][0]["place"]


def test_a_pose_ten_kilometres_away_is_taken(client: TestClient) -> None:
    pose = [[1, 0, 0, 6000], [0, 1, 0, -8000], *(list(row) for row in IDENTITY[2:])]
    answer = client.post("/scans", content=ply(), headers=RAW, params={"pose": json.dumps(pose)})
    assert (answer.status_code, answer.json()["pose"]) == (201, pose)


@pytest.mark.parametrize("when", ["2026-03-01", "2026-03-01T12:00:00", "1700000000", "noon"])
def test_a_time_without_a_zone_is_refused(client: TestClient, when: str) -> None:
    answer = client.post("/scans", content=ply(), headers=RAW, params={"captured_at": when})
    assert answer.status_code == 422
    assert answer.json()["errors"][0] == {
        "place": "query.captured_at",
        "value": when,
        "detail": "give an RFC 3339 date and time with its zone, such as 2026-03-01T12:00:00Z",
    }


def test_a_file_name_is_kept_as_one_short_line(client: TestClient) -> None:
    body = (
        b'--b\r\nContent-Disposition: form-data; name="file"; filename="../a\x00\x1b\xff'
        + b"x" * 300
        + b'.ply"\r\n\r\n'
        + ply()
        + b"\r\n--b--\r\n"
    )
    answer = client.post("/scans", content=body, headers={"Content-Type": "multipart/form-data; boundary=b"})
    name = answer.json()["filename"]
    assert len(name) == 255
    assert name.isprintable()


def test_a_form_takes_one_file_in_its_field(client: TestClient) -> None:
    two = client.post("/scans", files=[("file", ("a.ply", ply())), ("file", ("b.ply", ply()))])
    assert (two.status_code, two.json()["detail"][:7]) == (422, "2 files")
    other = client.post("/scans", files={"scan": ("a.ply", ply())})
    assert (other.status_code, "'file'" in other.json()["detail"]) == (422, True)
    none = client.post("/scans", data={"device_id": "a"}, files={})
    assert none.status_code == 415


def test_a_scan_is_deleted_once_and_not_while_a_map_rests_on_it(client: TestClient, catalog: Catalog) -> None:
    scan_id = client.post("/scans", content=ply(), headers=RAW).json()["scan_id"]
    assert client.delete(f"/scans/{scan_id}").status_code == 204
    assert client.delete(f"/scans/{scan_id}").status_code == 404
    add_map(catalog)
    used = catalog.maps.get("lobby").scans[0].scan_id
    assert client.delete(f"/scans/{used}").json()["type"] == "urn:spicd:problem:conflict"


TURNED = json.dumps(POSE)
MOVED = json.dumps([[1, 0, 0, 4], *IDENTITY[1:]])
LATER = "2026-03-02T12:00:00Z"


def test_the_same_bytes_with_another_pose_or_time_correct_a_scan_that_nothing_rests_on(
    client: TestClient,
) -> None:
    client.post("/scans", content=ply(), headers=RAW, params={"pose": TURNED, "filename": "hall.ply"})
    answer = client.post("/scans", content=ply(), headers=RAW, params={"pose": MOVED, "captured_at": LATER})
    scan = answer.json()
    assert (answer.status_code, scan["pose"], scan["captured_at"]) == (200, json.loads(MOVED), LATER)
    assert client.get(f"/scans/{scan['scan_id']}").json() == scan
    again = client.post("/scans", content=ply(), headers=RAW)
    assert (again.status_code, again.json()) == (200, scan)  # what is not said stays


def test_the_same_bytes_with_another_pose_are_taken_and_a_map_of_them_stays_as_it_was_asked_for(
    client: TestClient,
) -> None:
    scan = client.post("/scans", content=ply(), headers=RAW, params={"pose": TURNED}).json()
    before = client.post("/maps", json={"scan_ids": [scan["scan_id"]]}).json()["map_id"]
    again = client.post("/scans", content=ply(), headers=RAW, params={"pose": MOVED, "captured_at": LATER})
    assert (again.status_code, again.json()["scan_id"]) == (200, scan["scan_id"])
    assert (again.json()["pose"], again.json()["captured_at"]) == (json.loads(MOVED), LATER)
    after = client.post("/maps", json={"scan_ids": [scan["scan_id"]]}).json()["map_id"]
    poses = [client.get(f"/maps/{map_id}").json()["scans"][0]["pose"] for map_id in (before, after)]
    assert poses == [json.loads(TURNED), json.loads(MOVED)]


def test_an_upload_that_was_acknowledged_outlives_a_request_that_brought_the_same_bytes_and_failed(
    client: TestClient, catalog: Catalog, queue: RememberingQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[str] = []

    def refuse() -> None:
        sent.append(client.post("/scans", content=ply(), headers=RAW).json()["scan_id"])
        raise QueueUnavailable("the job queue does not answer")

    monkeypatch.setattr(queue, "ping", refuse)
    assert client.post("/maps", files={"scans": ("hall.ply", ply())}).status_code == 503
    assert catalog.blobs.get_bytes(catalog.scans.get(sent[0]).key) == ply()


@pytest.mark.parametrize("left", [None, b"ply\nfor"])
def test_the_same_bytes_sent_again_take_the_place_of_a_file_that_was_lost(
    client: TestClient, catalog: Catalog, left: bytes | None
) -> None:
    scan = client.post("/scans", content=ply(), headers=RAW).json()["scan_id"]
    key = catalog.scans.get(scan).key
    catalog.blobs.delete_prefix(key.rsplit("/", 1)[0])
    if left is not None:
        catalog.blobs.put_bytes(key, left)
    assert client.post("/scans", content=ply(), headers=RAW).json()["scan_id"] == scan
    assert catalog.blobs.get_bytes(catalog.scans.get(scan).key) == ply()


def test_a_start_sweeps_what_a_killed_process_left_and_no_upload_of_today(
    settings: Settings, queue: RememberingQueue
) -> None:
    folder = settings.data_dir / "incoming"
    folder.mkdir(parents=True)
    for name, age_s in (("old.part", 25 * 3600), ("new.part", 60)):
        (folder / name).write_bytes(b"ply")
        os.utime(folder / name, (time.time() - age_s,) * 2)
    with running(settings, queue):
        assert [path.name for path in folder.iterdir()] == ["new.part"]


def test_every_real_scan_is_taken_by_its_first_bytes_sound_or_not(
    client: TestClient, shared_data: Path
) -> None:
    """Whether it can be read is for the job to say; only what names neither format is refused here."""
    assert (shared_data / "formats/pypcd4/ascii_empty.pcd").read_bytes() == b""
    refused = []
    for path in sorted((shared_data / "formats").rglob("*.p[lc][yd]")):
        head = path.read_bytes()[:300]
        answer = client.post("/scans", content=head, headers=RAW, params={"filename": path.name})
        if answer.status_code == 422:
            refused.append(path.name)
        else:
            assert answer.json()["format"] == path.suffix[1:]
    assert refused == ["ascii_empty.pcd"]


@pytest.mark.parametrize(
    ("when", "said"), [("1970-01-01T00:00:07Z", "before 2010"), ("2099-01-01T00:00:00Z", "years after")]
)
def test_a_time_that_cannot_be_right_is_taken_and_told(client: TestClient, when: str, said: str) -> None:
    scan = client.post("/scans", content=ply(), headers=RAW, params={"captured_at": when}).json()
    assert scan["captured_at"] == when
    (warning,) = scan["warnings"]
    assert warning["reason"] == "clock"
    assert said in warning["detail"]
    assert client.get(f"/scans/{scan['scan_id']}").json()["warnings"] == [warning]


def test_the_right_time_sent_later_takes_the_warning_back(client: TestClient) -> None:
    for when, warned in (("1970-01-01T00:00:00Z", 1), ("2026-03-01T12:00:00Z", 0)):
        scan = client.post("/scans", content=ply(), headers=RAW, params={"captured_at": when}).json()
        assert len(scan["warnings"]) == warned
