"""/uploads by tus 1.0.0: what a client of the protocol may rely on, and that the last piece makes a scan."""

from __future__ import annotations

import base64
import hashlib
import json
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient

from service.catalog.files.uploads import Uploads
from service.catalog.sql.tables import now
from service.errors import DatabaseUnavailable, DiskFull
from service.settings import Settings
from tests.support.samples import RememberingQueue, catalog_of, ply, running

TUS = {"Tus-Resumable": "1.0.0"}
PIECE = {**TUS, "Content-Type": "application/offset+octet-stream"}
SCAN = ply("a hall") + bytes(range(256)) * 40
POSE = "1 2 3 0 0 0.7071068 0.7071068"
TURNED = ((0, -1, 0, 1), (1, 0, 0, 2), (0, 0, 1, 3), (0, 0, 0, 1))


def metadata(**said: str) -> dict[str, str]:
    pairs = (f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in said.items())
    return {"Upload-Metadata": ",".join(pairs)}


def begin(client: TestClient, length: int = len(SCAN), **said: str) -> str:
    headers = {**TUS, "Upload-Length": str(length), **(metadata(**said) if said else {})}
    answer = client.post("/uploads", headers=headers)
    assert answer.status_code == 201, answer.text
    assert answer.headers["Upload-Offset"] == "0"
    return str(answer.headers["Location"])


def send(client: TestClient, url: str, offset: int, data: bytes, **headers: str) -> httpx.Response:
    said = {**PIECE, "Upload-Offset": str(offset), **headers}
    return client.patch(url, content=data, headers=said)


def offset(client: TestClient, url: str) -> int:
    answer = client.head(url, headers=TUS)
    assert answer.status_code == 200, answer.text
    return int(answer.headers["Upload-Offset"])


def code(answer: httpx.Response) -> str:
    return str(answer.json()["type"]).rpartition(":")[2]


def test_pieces_become_the_scan_that_one_body_would_have_become(client: TestClient) -> None:
    when = "2026-03-01T12:00:00Z"
    url = begin(client, filename="hall.ply", device_id="robot-7", captured_at=when, pose=POSE, frame="map")
    for start in range(0, len(SCAN), 1000):
        answer = send(client, url, start, SCAN[start : start + 1000])
        assert (answer.status_code, answer.headers["Tus-Resumable"]) == (204, "1.0.0")
        assert int(answer.headers["Upload-Offset"]) == min(start + 1000, len(SCAN)) == offset(client, url)
    scan = client.get(f"/scans/{answer.headers['Scan-Id']}").json()
    assert scan["sha256"] == hashlib.sha256(SCAN).hexdigest()
    assert scan["captured_at"] == when
    assert [scan[name] for name in ("filename", "device_id", "frame")] == ["hall.ply", "robot-7", "map"]
    for row, wanted in zip(scan["pose"], TURNED, strict=True):
        assert row == pytest.approx(wanted, abs=1e-6)
    query = {"filename": "hall.ply", "device_id": "robot-7"}
    raw = {"Content-Type": "application/octet-stream"}
    again = client.post("/scans", params=query, content=SCAN, headers=raw)
    assert (again.status_code, again.json()["scan_id"]) == (200, scan["scan_id"])
    assert catalog_of(client).blobs.get_bytes(catalog_of(client).scans.get(scan["scan_id"]).key) == SCAN


def test_the_scan_is_told_also_when_the_last_answer_was_lost(client: TestClient) -> None:
    url = begin(client)
    scan_id = send(client, url, 0, SCAN).headers["Scan-Id"]
    head = client.head(url, headers=TUS)
    assert (head.headers["Scan-Id"], head.headers["Upload-Length"]) == (scan_id, str(len(SCAN)))
    seen = client.get(url).json()
    assert (seen["scan_id"], seen["offset"], seen["problem"]) == (scan_id, len(SCAN), None)
    assert f"/scans/{scan_id}" in [link["href"] for link in seen["links"]]
    repeated = send(client, url, len(SCAN), b"")
    assert (repeated.status_code, repeated.headers["Scan-Id"]) == (204, scan_id)


def test_what_is_spoken_is_told(client: TestClient) -> None:
    answer = client.options("/uploads")
    assert answer.status_code == 204
    assert answer.headers["Tus-Version"] == "1.0.0"
    assert "termination" in answer.headers["Tus-Extension"]
    assert answer.headers["Tus-Checksum-Algorithm"] == "sha1,sha256"
    assert answer.headers["Tus-Max-Size"] == "200000"


def test_a_piece_that_begins_elsewhere_is_refused_and_nothing_of_it_kept(client: TestClient) -> None:
    url = begin(client)
    send(client, url, 0, SCAN[:500])
    for wrong in (0, 499, 501, len(SCAN)):
        answer = send(client, url, wrong, b"x")
        assert (answer.status_code, code(answer)) == (409, "offset_mismatch")
    assert offset(client, url) == 500


@pytest.mark.parametrize("algorithm", ["sha1", "sha256"])
def test_a_piece_with_another_checksum_is_refused_and_nothing_of_it_kept(
    client: TestClient, algorithm: str
) -> None:
    url = begin(client)
    right = base64.b64encode(hashlib.new(algorithm, SCAN[:700]).digest()).decode()
    wrong = send(client, url, 0, SCAN[1:701], **{"Upload-Checksum": f"{algorithm} {right}"})
    assert (wrong.status_code, code(wrong)) == (460, "checksum_mismatch")
    assert offset(client, url) == 0
    assert send(client, url, 0, SCAN[:700], **{"Upload-Checksum": f"{algorithm} {right}"}).status_code == 204
    answer = send(client, url, 700, SCAN[700:])
    assert (
        client.get(f"/scans/{answer.headers['Scan-Id']}").json()["sha256"] == hashlib.sha256(SCAN).hexdigest()
    )


@pytest.mark.parametrize("value", ["md5 abcd", "sha1", "sha1 !!!!", "sha1 YWJj"])
def test_a_checksum_that_cannot_be_read_is_refused(client: TestClient, value: str) -> None:
    answer = send(client, begin(client), 0, SCAN, **{"Upload-Checksum": value})
    assert (answer.status_code, code(answer)) == (400, "tus_malformed")


def test_what_is_no_scan_is_refused_with_its_first_bytes(client: TestClient) -> None:
    url = begin(client, 150_000, filename="cat.png")
    answer = send(client, url, 0, b"\x89PNG" + bytes(1000))
    assert (answer.status_code, code(answer)) == (422, "scan_unreadable")
    assert "cat.png" in answer.json()["detail"]
    assert client.head(url, headers=TUS).status_code == 422
    seen = client.get(url).json()
    assert (seen["scan_id"], seen["problem"]["type"]) == (None, "urn:spicd:problem:scan_unreadable")
    assert send(client, url, 1004, bytes(10)).status_code == 422


@pytest.mark.parametrize(
    ("said", "place"),
    [
        ({"pose": "1 2 3"}, "pose"),
        ({"pose": "0 0 0 0 0 0 2"}, "pose"),
        ({"captured_at": "yesterday"}, "captured_at"),
        ({"frame": "a b"}, "frame"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_what_is_wrongly_said_of_a_scan_is_refused_before_any_byte(
    client: TestClient, said: dict[str, str], place: str
) -> None:
    answer = client.post("/uploads", headers={**TUS, "Upload-Length": "9", **metadata(**said)})
    assert (answer.status_code, code(answer)) == (422, "invalid_request")
    assert answer.json()["errors"][0]["place"].startswith(f"Upload-Metadata.{place}")


def test_what_clients_of_others_say_by_themselves_does_no_harm(client: TestClient) -> None:
    url = begin(client, name="hall.ply", filetype="", type="model/ply", relativePath="null")
    scan_id = send(client, url, 0, SCAN).headers["Scan-Id"]
    assert client.get(f"/scans/{scan_id}").json()["filename"] == "hall.ply"


@pytest.mark.parametrize(
    ("headers", "status", "problem"),
    [
        ({"Upload-Length": "9"}, 412, "tus_version"),
        ({**TUS, "Tus-Resumable": "0.2.2", "Upload-Length": "9"}, 412, "tus_version"),
        (TUS, 400, "tus_malformed"),
        ({**TUS, "Upload-Defer-Length": "1"}, 400, "tus_malformed"),
        ({**TUS, "Upload-Length": "-1"}, 400, "tus_malformed"),
        ({**TUS, "Upload-Length": "200001"}, 413, "too_large"),
        ({**TUS, "Upload-Length": "0"}, 422, "scan_unreadable"),
        ({**TUS, "Upload-Length": "9", "Upload-Metadata": "filename ???"}, 400, "tus_malformed"),
        ({**TUS, "Upload-Length": "9", "Upload-Metadata": "pose MQ==,pose MQ=="}, 400, "tus_malformed"),
    ],
)
def test_a_beginning_that_breaks_the_protocol_is_refused(
    client: TestClient, headers: dict[str, str], status: int, problem: str
) -> None:
    answer = client.post("/uploads", headers=headers)
    assert (answer.status_code, code(answer)) == (status, problem)
    assert answer.headers["Tus-Resumable"] == "1.0.0"
    assert ("Tus-Version" in answer.headers) == (status == 412)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Content-Type": "application/octet-stream"}, 415),
        ({"Upload-Offset": "x"}, 400),
        ({"Tus-Resumable": "2"}, 412),
    ],
)
def test_a_piece_that_breaks_the_protocol_is_refused(
    client: TestClient, headers: dict[str, str], status: int
) -> None:
    url = begin(client)
    said = {**PIECE, "Upload-Offset": "0", **headers}
    assert client.patch(url, content=SCAN, headers=said).status_code == status
    assert offset(client, url) == 0


def test_a_piece_that_goes_on_behind_the_end_is_refused(client: TestClient) -> None:
    url = begin(client)
    answer = send(client, url, 0, SCAN + b"x")
    assert (answer.status_code, code(answer)) == (413, "too_large")
    assert offset(client, url) == 0


def test_the_first_piece_may_come_with_the_beginning(client: TestClient) -> None:
    answer = client.post("/uploads", content=SCAN, headers={**PIECE, "Upload-Length": str(len(SCAN))})
    assert (answer.status_code, answer.headers["Upload-Offset"]) == (201, str(len(SCAN)))
    assert client.get(f"/scans/{answer.headers['Scan-Id']}").status_code == 200
    part = client.post("/uploads", content=SCAN[:300], headers={**PIECE, "Upload-Length": str(len(SCAN))})
    assert offset(client, part.headers["Location"]) == 300


def test_a_method_may_be_named_in_a_header(client: TestClient) -> None:
    url = begin(client)
    said = {**PIECE, "Upload-Offset": "0", "X-HTTP-Method-Override": "PATCH"}
    assert client.post(url, content=SCAN[:400], headers=said).headers["Upload-Offset"] == "400"
    assert client.post(url, headers={**TUS, "X-HTTP-Method-Override": "DELETE"}).status_code == 204
    assert client.head(url, headers=TUS).status_code == 404
    assert client.post(url, headers=TUS).status_code == 405


def test_what_is_given_up_is_gone_with_its_bytes(client: TestClient, settings: Settings) -> None:
    url = begin(client)
    send(client, url, 0, SCAN[:500])
    assert client.delete(url, headers=TUS).status_code == 204
    assert client.delete(url, headers=TUS).status_code == 404
    assert send(client, url, 500, SCAN[500:]).status_code == 404
    assert list((settings.data_dir / "uploads").iterdir()) == []


def test_giving_up_what_became_a_scan_leaves_the_scan(client: TestClient) -> None:
    url = begin(client)
    scan_id = send(client, url, 0, SCAN).headers["Scan-Id"]
    assert client.delete(url, headers=TUS).status_code == 204
    assert client.get(f"/scans/{scan_id}").status_code == 200


def test_an_upload_expires_so_long_after_its_last_byte(client: TestClient, settings: Settings) -> None:
    url = begin(client)
    assert "Upload-Expires" in client.head(url, headers=TUS).headers
    uploads = Uploads(settings.data_dir / "uploads", keep=timedelta(hours=24))
    upload_id = url.rpartition("/")[2]
    with uploads.opened(upload_id) as one:
        one._update(expires=now() - timedelta(seconds=1))
        assert uploads.sweep() == 0  # somebody is at it
    assert client.head(url, headers=TUS).status_code == 404
    assert uploads.sweep() == 1
    assert not (settings.data_dir / "uploads" / upload_id).exists()


def test_uploads_go_on_in_a_service_that_was_started_anew(
    settings: Settings, queue: RememberingQueue
) -> None:
    with running(settings, queue) as client:
        url = begin(client)
        send(client, url, 0, SCAN[:500])
    with running(settings, queue) as client:
        assert offset(client, url) == 500
        scan_id = send(client, url, 500, SCAN[500:]).headers["Scan-Id"]
        assert client.get(f"/scans/{scan_id}").json()["sha256"] == hashlib.sha256(SCAN).hexdigest()


def test_bytes_behind_the_offset_are_no_part_of_the_upload(client: TestClient, settings: Settings) -> None:
    """As a kill leaves them: written, and not yet known to be on the disk."""
    url = begin(client)
    send(client, url, 0, SCAN[:500])
    with (settings.data_dir / "uploads" / url.rpartition("/")[2] / "data").open("ab") as file:
        file.write(b"half a piece")
    assert offset(client, url) == 500
    scan_id = send(client, url, 500, SCAN[500:]).headers["Scan-Id"]
    assert client.get(f"/scans/{scan_id}").json()["sha256"] == hashlib.sha256(SCAN).hexdigest()


def test_a_whole_upload_becomes_a_scan_when_the_database_is_back(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: object, **__: object) -> None:
        raise DatabaseUnavailable("the database does not answer")

    url = begin(client)
    with monkeypatch.context() as patch:
        patch.setattr(catalog_of(client).scans, "add", away)
        answer = send(client, url, 0, SCAN)
        assert (answer.status_code, code(answer)) == (503, "database_unavailable")
        assert client.get(url).json()["offset"] == len(SCAN)
        assert client.head(url, headers=TUS).status_code == 503
    head = client.head(url, headers=TUS)
    assert head.headers["Upload-Offset"] == str(len(SCAN))
    assert client.get(f"/scans/{head.headers['Scan-Id']}").status_code == 200


def test_a_scan_in_use_that_comes_again_with_another_pose_is_corrected(client: TestClient) -> None:
    catalog = catalog_of(client)
    scan_id = send(client, begin(client, pose=POSE), 0, SCAN).headers["Scan-Id"]
    catalog.maps.create(scan_ids=[scan_id], model="spicd-net/1", map_id="lobby")
    answer = send(client, begin(client, pose="0 0 0 0 0 0 1"), 0, SCAN)
    assert (answer.status_code, answer.headers["Scan-Id"]) == (204, scan_id)
    identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert client.get(f"/scans/{scan_id}").json()["pose"] == identity


def test_no_more_uploads_are_begun_than_may_be(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.catalog.files.uploads.MAX_UPLOADS", 2)
    for _ in range(2):
        begin(client)
    answer = client.post("/uploads", headers={**TUS, "Upload-Length": "9"})
    assert (answer.status_code, code(answer), answer.headers["Retry-After"]) == (
        429,
        "too_many_uploads",
        "60",
    )


def test_a_disk_without_room_for_the_file_takes_none_of_it(tmp_path: Path, settings: Settings) -> None:
    full = settings.model_copy(update={"min_free_bytes": 1 << 60})
    with running(full, RememberingQueue()) as client:
        answer = client.post("/uploads", headers={**TUS, "Upload-Length": "9"})
        assert (answer.status_code, code(answer)) == (507, "disk_full")


def test_a_disk_that_fills_while_pieces_come_keeps_those_before(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_self: object, coming: int = 0) -> None:
        raise DiskFull("no room")

    url = begin(client)
    send(client, url, 0, SCAN[:500])
    with monkeypatch.context() as patch:
        patch.setattr("service.catalog.files.disk.Disk.require", full)
        answer = send(client, url, 500, SCAN[500:])
        assert (answer.status_code, code(answer)) == (507, "disk_full")
        assert offset(client, url) == 500
    scan_id = send(client, url, 500, SCAN[500:]).headers["Scan-Id"]
    assert client.get(f"/scans/{scan_id}").json()["sha256"] == hashlib.sha256(SCAN).hexdigest()


def test_the_pose_forms_say_the_same(client: TestClient) -> None:
    forms = (
        POSE,
        POSE.replace(" ", ", "),
        json.dumps([float(word) for word in POSE.split()]),
        json.dumps(TURNED),
    )
    for number, form in enumerate(forms):
        data = ply(f"scan {number}")
        raw = {"Content-Type": "application/octet-stream"}
        scan = client.post("/scans", params={"pose": form}, content=data, headers=raw).json()
        for row, wanted in zip(scan["pose"], TURNED, strict=True):
            assert row == pytest.approx(wanted, abs=1e-6)
