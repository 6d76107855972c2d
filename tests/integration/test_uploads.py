"""Uploads that are broken on purpose: whoever is killed, and at whatever byte, the same file arrives."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.resumable import Memory, Persistence, upload
from tests.support.api_process import ROOT, ApiProcess
from tests.support.bad_link import bad_link
from tests.support.processes import until
from tests.support.tools import TESTS, needs_tools, run

SIZE = 6_000_000
QUICK = Persistence(first_wait_s=0.05, longest_wait_s=0.5, idle_s=60, first_piece=1 << 20)
TUS = {"Tus-Resumable": "1.0.0"}


@pytest.fixture
def api(tmp_path: Path) -> Iterator[ApiProcess]:
    process = ApiProcess(tmp_path)
    yield process
    process.kill()


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    path = tmp_path / "hall.ply"
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {SIZE}\nproperty uchar x\nend_header\n"
    path.write_bytes(header.encode() + random.Random(7).randbytes(SIZE))
    return path


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Sending(threading.Thread):
    """`resumable.upload` in a thread."""

    def __init__(self, url: str, path: Path, memory: Memory | None = None) -> None:
        super().__init__(daemon=True)
        self._url, self._path, self._memory = url, path, memory
        self.scan: dict[str, object] = {}
        self.start()

    def run(self) -> None:
        with httpx.Client(base_url=self._url) as http:
            self.scan = upload(http, self._path, memory=self._memory, persistence=QUICK)

    def ended(self) -> dict[str, object]:
        self.join(90)
        assert not self.is_alive()
        return self.scan


@pytest.mark.parametrize("seed", range(2))
def test_a_service_that_is_killed_at_any_byte_has_the_same_file_in_the_end(
    api: ApiProcess, scan: Path, seed: int
) -> None:
    kills = sorted(random.Random(seed).sample(range(SIZE), 4))
    with bad_link(api.port, rate=4e6) as link:
        sending = Sending(link.url, scan)
        for at in kills:
            until(lambda at=at: api.received() >= at or not sending.is_alive())  # type: ignore[misc]
            assert sending.is_alive()
            api.kill()
            api.start()
        assert sending.ended()["sha256"] == sha256(scan)
        assert link.sent < 2.5 * SIZE  # at most what came since it was last put on the disk is sent again
    assert len(api.uploads()) == 1


def test_a_link_that_breaks_all_the_time_lets_the_file_through(api: ApiProcess, scan: Path) -> None:
    with bad_link(api.port, rate=3e6, drop_every_s=0.4) as link:
        assert Sending(link.url, scan).ended()["sha256"] == sha256(scan)
        assert link.drops >= 3
        assert link.sent < 1.5 * SIZE
    assert len(api.uploads()) == 1


def test_a_client_that_is_killed_goes_on_where_it_was(api: ApiProcess, scan: Path, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "service", "scans", "add", str(scan), "--json", "--device-id", "robot-7"]
    moments = sorted(random.Random(3).sample(range(SIZE // 10, SIZE), 3))
    with bad_link(api.port, rate=3e6) as link:
        environment = {**os.environ, "SPICD_URL": link.url, "XDG_STATE_HOME": str(tmp_path / "state")}
        for at in moments:
            client = subprocess.Popen(words, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL)
            until(lambda at=at: api.received() >= at, 60)  # type: ignore[misc]
            client.kill()
            client.wait()
        done = subprocess.run(
            words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True, timeout=90
        )
        assert link.sent < 1.5 * SIZE
    (document,) = json.loads(done.stdout)
    assert (document["sha256"], document["device_id"]) == (sha256(scan), "robot-7")
    assert len(api.uploads()) == 1


def test_a_newer_connection_takes_over_from_one_that_is_silent(api: ApiProcess, scan: Path) -> None:
    """A robot that lost its Wi-Fi comes again while the old connection still looks alive."""
    data = scan.read_bytes()
    with httpx.Client(base_url=api.url, timeout=30) as http, contextlib.ExitStack() as stack:
        url = http.post("/uploads", headers={**TUS, "Upload-Length": str(len(data))}).headers["Location"]
        old = stack.enter_context(socket.create_connection(("127.0.0.1", api.port)))
        head = (
            f"PATCH {url} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
            f"Content-Type: application/offset+octet-stream\r\nContent-Length: {len(data)}\r\n\r\n"
        )
        old.sendall(head.encode() + data[:700_000])
        until(lambda: api.received() > 400_000)
        kept = int(http.head(url, headers=TUS).headers["Upload-Offset"])
        assert 400_000 < kept <= 700_000
        old.settimeout(30)
        assert old.recv(100).startswith(b"HTTP/1.1 423")
        headers = {**TUS, "Content-Type": "application/offset+octet-stream", "Upload-Offset": str(kept)}
        answer = http.patch(url, content=data[kept:], headers=headers)
        assert answer.status_code == 204
        scan_id = answer.headers["Scan-Id"]
        assert http.get(f"/scans/{scan_id}").json()["sha256"] == sha256(scan)


def test_a_connection_that_breaks_within_a_piece_with_a_checksum_leaves_nothing_of_it(
    api: ApiProcess, scan: Path
) -> None:
    data = scan.read_bytes()
    with httpx.Client(base_url=api.url, timeout=30) as http:
        url = http.post("/uploads", headers={**TUS, "Upload-Length": str(len(data))}).headers["Location"]
        with socket.create_connection(("127.0.0.1", api.port)) as old:
            head = (
                f"PATCH {url} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
                f"Upload-Checksum: sha1 {'A' * 27}=\r\nContent-Type: application/offset+octet-stream\r\n"
                f"Content-Length: {len(data)}\r\n\r\n"
            )
            old.sendall(head.encode() + data[:5_000_000])
            until(lambda: api.received() > 4_000_000)
        assert http.head(url, headers=TUS).headers["Upload-Offset"] == "0"


def test_the_page_for_robots_uploads_with_curl(api: ApiProcess, scan: Path) -> None:
    page = (ROOT / "docs/robots.md").read_text()
    (script,) = re.findall(r"^```sh\n(TUS=.*?)^```", page, re.MULTILINE | re.DOTALL)
    environment = {**os.environ, "SPICD_URL": api.url, "SPICD_KEY": "none"}
    done = subprocess.run(
        ["/bin/bash", "-euc", script],
        cwd=scan.parent,
        env=environment,
        capture_output=True,
        check=True,
        timeout=60,
    )
    assert b"Scan-Id" in done.stdout or b"scan-id" in done.stdout
    (document,) = httpx.get(f"{api.url}/scans").json()["scans"]
    assert (document["sha256"], document["frame"]) == (sha256(scan), "map")
    assert [row[3] for row in document["pose"]] == [2.5, 0, 0.35, 1]


@needs_tools
def test_tuspy_uploads_and_goes_on(api: ApiProcess, scan: Path) -> None:
    script = TESTS / "upload_by_tuspy.py"
    url = run("python", script, api.url, scan, "-", "2000000").strip()
    offset = int(httpx.head(url, headers=TUS).headers["Upload-Offset"])
    assert 2_000_000 <= offset < SIZE
    api.kill()
    api.start()
    assert run("python", script, api.url, scan, url, "0").strip() == url
    _is_the_scan(api, url, scan)


@needs_tools
def test_tus_js_client_uploads_and_goes_on(api: ApiProcess, scan: Path, tmp_path: Path) -> None:
    script, state = TESTS / "upload_by_tus.mjs", tmp_path / "urls.json"
    url = run("node", script, api.url, scan, state, "2000000").strip()
    offset = int(httpx.head(url, headers=TUS).headers["Upload-Offset"])
    assert 2_000_000 <= offset < SIZE
    api.kill()
    api.start()
    assert run("node", script, api.url, scan, state, "0").strip() == url
    _is_the_scan(api, url, scan)


def _is_the_scan(api: ApiProcess, url: str, scan: Path) -> None:
    seen = httpx.get(url).json()
    document = httpx.get(f"{api.url}/scans/{seen['scan_id']}").json()
    assert (document["sha256"], document["filename"]) == (sha256(scan), "hall.ply")
    assert document["device_id"] == "robot-7"
    assert len(api.uploads()) == 1
