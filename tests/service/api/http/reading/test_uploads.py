"""A large upload to a real server process: memory stays small, and a connection that breaks leaves nothing."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.http.reading.uploads import AFTERWARDS_S, Incoming, sweep
from tests.support.samples import settings_in

PIECE = bytes(range(256)) * 4096  #: 1 MiB
HEAD = b"ply\nformat binary_little_endian 1.0\n"
SIZE = 400_000_000
RAW = {"Content-Type": "application/octet-stream"}
FORM = {"Content-Type": "multipart/form-data; boundary=edge"}

SERVER = """
import sys, uvicorn
from tests.support.samples import RememberingQueue
from service.api.app import create_app
from service.settings import Settings
settings = Settings(data_dir=sys.argv[1], model_store=sys.argv[2])
uvicorn.run(create_app(settings, queue=RememberingQueue()), port=int(sys.argv[3]), log_level="warning")
"""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[httpx.Client, int, Path]]:
    """A client of a server process, the process's id, and its data folder."""
    settings = settings_in(tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    root = Path(__file__).resolve().parents[5]
    process = subprocess.Popen(
        [sys.executable, "-c", SERVER, settings.data_dir, settings.model_store, str(port)],
        cwd=root,
        env={"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin"},
    )
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=120) as client:
            _wait(client, process)
            yield client, process.pid, settings.data_dir
    finally:
        process.terminate()
        process.wait(20)
        shutil.rmtree(settings.data_dir, ignore_errors=True)


def _wait(client: httpx.Client, process: subprocess.Popen[bytes]) -> None:
    for _ in range(600):
        try:
            client.get("/health/live")
            return
        except httpx.TransportError:
            assert process.poll() is None, "the server ended"
            time.sleep(0.1)
    raise AssertionError("the server does not answer")


def content(size: int, before: bytes = b"", after: bytes = b"") -> Iterator[bytes]:
    yield before + HEAD
    left = size - len(HEAD)
    while left > 0:
        yield PIECE[:left]
        left -= len(PIECE)
    yield after


def peak_megabytes(pid: int) -> float:
    """The largest resident size that the process ever had (proc(5), VmHWM)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak from /proc")
def test_400_megabytes_raw_and_as_a_form_leave_the_server_under_200_resident(
    server: Any, record_property: Callable[[str, object], None]
) -> None:
    client, pid, data_dir = server
    raw = client.post("/scans", content=content(SIZE), headers=RAW, params={"device_id": "raw"})
    after_raw = peak_megabytes(pid)
    start = (
        b'--edge\r\nContent-Disposition: form-data; name="device_id"\r\n\r\nform\r\n'
        b'--edge\r\nContent-Disposition: form-data; name="file"; filename="hall.ply"\r\n\r\n'
    )
    form = client.post("/scans", content=content(SIZE, start, b"\r\n--edge--\r\n"), headers=FORM)
    after_form = peak_megabytes(pid)
    record_property("peak_megabytes", [after_raw, after_form])
    assert (raw.status_code, form.status_code) == (201, 201)
    assert raw.json()["size"] == form.json()["size"] == SIZE
    assert raw.json()["sha256"] == form.json()["sha256"]
    assert raw.json()["scan_id"] != form.json()["scan_id"]
    assert list((data_dir / "incoming").iterdir()) == []
    assert max(after_raw, after_form) < 200


def test_a_connection_that_breaks_within_the_body_leaves_nothing(server: Any) -> None:
    client, _, data_dir = server
    incoming = data_dir / "incoming"
    with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
        connection.sendall(
            b"POST /scans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/octet-stream\r\n"
            b"Content-Length: 9000000\r\n\r\n" + HEAD + 3 * PIECE
        )
        _until(lambda: incoming.exists() and any(path.stat().st_size for path in incoming.iterdir()))
    _until(lambda: not any(incoming.iterdir()))
    assert client.get("/scans").json()["scans"] == []


def _until(true: Callable[[], bool]) -> None:
    for _ in range(300):
        if true():
            return
        time.sleep(0.05)
    raise AssertionError("it did not come about")


def test_what_a_killed_process_left_goes_when_no_upload_may_still_need_it(tmp_path: Path) -> None:
    for name, age_s in (("gone", 7200 + AFTERWARDS_S + 1), ("slow", 7200), ("new", 0)):
        path = tmp_path / f"{name}.part"
        path.touch()
        os.utime(path, (time.time() - age_s,) * 2)
    sweep(tmp_path, upload_timeout_s=7200)
    assert {path.stem for path in tmp_path.iterdir()} == {"slow", "new"}


def test_the_first_file_of_a_form_that_goes_on_is_not_swept_however_old(tmp_path: Path) -> None:
    with Incoming(tmp_path, "first.ply") as first:
        first.write(HEAD)
        path = first.finish().path
        os.utime(path, (0, 0))
        sweep(tmp_path, upload_timeout_s=1)
        assert path.is_file()
    assert not path.exists()
    path.touch()
    os.utime(path, (0, 0))
    sweep(tmp_path, upload_timeout_s=1)
    assert not path.exists()  # of an earlier process
