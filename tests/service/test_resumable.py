"""The client's side of a resumable upload, against a service that misbehaves as services and links do."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from service import resumable
from service.resumable import FileChanged, Memory, Persistence, UploadRefused, UploadStalled, upload

DATA = b"ply\n" + bytes(range(250)) * 8


class Service:
    """A service of tus that keeps what came, and does what `before` says first."""

    def __init__(self) -> None:
        self.data = b""
        self.begun = 0
        self.before: list[Callable[[httpx.Request], httpx.Response | None]] = []
        self.sha256: str | None = None

    def __call__(self, request: httpx.Request) -> httpx.Response:
        if self.before and (answer := self.before.pop(0)(request)) is not None:
            return answer
        if request.method == "POST":
            self.begun, self.data = self.begun + 1, b""
            return httpx.Response(201, headers={"Location": "/uploads/1"})
        if request.method == "PATCH":
            assert int(request.headers["Upload-Offset"]) == len(self.data)
            self.data += request.read()
        if request.url.path.startswith("/scans"):
            digest = self.sha256 or hashlib.sha256(self.data).hexdigest()
            return httpx.Response(200, json={"scan_id": "scan-1", "sha256": digest})
        told = {"Upload-Offset": str(len(self.data))}
        return httpx.Response(
            204, headers=told | ({"Scan-Id": "scan-1"} if len(self.data) == len(DATA) else {})
        )


def answers(status: int, **headers: str) -> Callable[[httpx.Request], httpx.Response]:
    return lambda _: httpx.Response(status, headers=headers, json={"title": "No", "detail": "so it is"})


def breaks(_: httpx.Request) -> httpx.Response:
    raise httpx.ReadError("reset")


@pytest.fixture
def service() -> Service:
    return Service()


@pytest.fixture
def http(service: Service) -> httpx.Client:
    return httpx.Client(base_url="http://robot.example", transport=httpx.MockTransport(service))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "hall.ply"
    path.write_bytes(DATA)
    return path


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    waited: list[float] = []
    monkeypatch.setattr("service.resumable.time.sleep", waited.append)
    return waited


def test_retry_after_is_waited_for_and_waits_grow_with_jitter(
    service: Service, http: httpx.Client, file: Path, waits: list[float]
) -> None:
    service.before = [breaks, breaks, breaks, answers(503, **{"Retry-After": "40"}), answers(429)]
    assert upload(http, file)["scan_id"] == "scan-1"
    assert service.data == DATA
    limits = [(0.25, 0.5), (0.5, 1), (1, 2), (42, 44), (4, 8)]
    assert all(least <= wait <= most for wait, (least, most) in zip(waits, limits, strict=True))


def test_a_service_that_stays_away_is_given_up_with_what_is_there(
    service: Service, http: httpx.Client, file: Path, waits: list[float]
) -> None:
    service.before = [breaks] * 10
    with pytest.raises(
        UploadStalled, match=r"hall\.ply: .*does not answer \(reset\); 0 of 2004 bytes are there"
    ):
        upload(http, file, persistence=Persistence(idle_s=-1))


def test_an_upload_that_is_gone_is_begun_anew(
    service: Service, http: httpx.Client, file: Path, waits: list[float]
) -> None:
    service.before = [lambda _: None, answers(404), answers(404)]
    assert upload(http, file)["sha256"] == hashlib.sha256(DATA).hexdigest()
    assert service.begun == 2


def test_pieces_shrink_while_none_of_them_arrives(
    service: Service, http: httpx.Client, file: Path, waits: list[float]
) -> None:
    sizes: list[int] = []

    def lose(request: httpx.Request) -> httpx.Response | None:
        sizes.append(len(request.read()))
        raise httpx.WriteError("reset")

    service.before = [lambda _: None, lose, lambda _: None, lose, lambda _: None, lose]
    upload(http, file, persistence=Persistence(first_piece=1600, least_piece=500))
    assert sizes == [1600, 800, 500]


def test_another_process_goes_on_by_the_memory(
    service: Service, http: httpx.Client, file: Path, tmp_path: Path
) -> None:
    memory = tmp_path / "uploads.json"
    service.before = [lambda _: None, answers(400)]
    with pytest.raises(UploadRefused):
        upload(http, file, memory=Memory(memory))
    assert json.loads(memory.read_text()) == {}  # what was refused is not gone on with
    service.before = [lambda _: None, answers(401)]
    with pytest.raises(UploadRefused):
        upload(http, file, memory=Memory(memory))
    service.data = DATA[:700]
    upload(http, file, memory=Memory(memory))
    assert (service.begun, service.data) == (2, DATA)
    assert json.loads(memory.read_text()) == {}


def test_a_file_that_is_written_to_meanwhile_is_not_taken_for_sent(
    service: Service, http: httpx.Client, file: Path
) -> None:
    def grow(_: httpx.Request) -> None:
        file.write_bytes(DATA + b"more")

    service.before = [grow]
    with pytest.raises(FileChanged, match="written to"):
        upload(http, file)


def test_other_bytes_at_the_service_are_an_error(service: Service, http: httpx.Client, file: Path) -> None:
    service.sha256 = "00"
    with pytest.raises(UploadRefused, match="Another file arrived"):
        upload(http, file)


def test_a_memory_that_cannot_be_read_is_empty(tmp_path: Path) -> None:
    (tmp_path / "uploads.json").write_text("{half")
    assert Memory(tmp_path / "uploads.json").find("any") is None
    assert resumable.Memory().find("any") is None
