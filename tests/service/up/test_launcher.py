"""`spicd up` before anything of it runs: it does not listen where nobody could ask."""

from __future__ import annotations

import os
import signal
import socket
import stat
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.catalog.keys import open_keys
from service.settings import Settings
from service.up.embedded_redis import LaunchFailed
from service.up.launcher import Running, _app, environment_of, up


class Started(Exception):
    """It got as far as being ready."""


def launch(folder: Path, then: Callable[[int], None] = lambda _: None, **given: Any) -> None:
    """Start the API alone, without a queue, and end once it is ready and `then` was called with its port."""

    def ready(running: Running) -> None:
        then(int(running.url.rpartition(":")[2]))
        raise Started

    up(api_alone(folder, **given), on_ready=ready)


def api_alone(folder: Path, **given: Any) -> Settings:
    return Settings(
        data_dir=folder,
        port=0,
        redis_url="redis://127.0.0.1:1/0",
        geometry_workers=0,
        inference_workers=0,
        **given,
    )


@pytest.fixture(autouse=True)
def _any_redis_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the Redis of these tests, which nobody asks, for one that answers; test_requirements.py has the check."""
    monkeypatch.setattr("service.up.launcher.require_queue", lambda settings: None)


def test_beyond_loopback_it_does_not_start_without_a_key_and_says_how_one_is_made(tmp_path: Path) -> None:
    with pytest.raises(LaunchFailed, match=r"spicd keys add .* SPICD_AUTH=none"):
        launch(tmp_path, host="0.0.0.0")


def test_a_key_that_was_revoked_is_none(tmp_path: Path) -> None:
    with open_keys(Settings(data_dir=tmp_path)) as keys:
        keys.revoke(keys.add("first", scopes=["admin"])[0].key_id)
    with pytest.raises(LaunchFailed, match="there is none"):
        launch(tmp_path, host="0.0.0.0")


def test_with_a_key_it_starts(tmp_path: Path) -> None:
    with open_keys(Settings(data_dir=tmp_path)) as keys:
        keys.add("first", scopes=["admin"])
    with pytest.raises(Started):
        launch(tmp_path, host="0.0.0.0")


@pytest.mark.parametrize("given", [{}, {"host": "0.0.0.0", "auth": "none"}])
def test_on_loopback_or_behind_something_that_asks_it_needs_none(
    tmp_path: Path, given: dict[str, Any]
) -> None:
    with pytest.raises(Started):
        launch(tmp_path, **given)


def test_loopback_may_be_told_to_need_one(tmp_path: Path) -> None:
    with pytest.raises(LaunchFailed, match="spicd keys add"):
        launch(tmp_path, auth="required")


def test_workers_do_not_inherit_the_key_of_a_client(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPICD_KEY", "spicd_secret")
    assert "spicd_secret" not in environment_of(Settings()).values()


def test_nobody_else_on_the_machine_reads_what_the_service_keeps(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        data = tmp_path / "data"
        (data / "blobs").mkdir(parents=True)
        (data / "blobs" / "of an earlier release").touch()
        with pytest.raises(Started):
            launch(data)
        for path in (data, *data.rglob("*")):
            assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path
        assert (data / "spicd.sqlite").exists()
    finally:
        os.umask(before)


def test_a_folder_that_cannot_be_made_is_told_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LaunchFailed, match="SPICD_DATA_DIR"):
        launch(tmp_path / "file" / "data")


def test_a_connection_of_a_proxy_is_kept_longer_than_uvicorn_does(tmp_path: Path) -> None:
    addresses: list[object] = []

    def ask_twice(port: int) -> None:
        limits = httpx.Limits(keepalive_expiry=60)
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", limits=limits) as client:
            for pause_s in (0.0, 6.0):
                time.sleep(pause_s)
                answer = client.get("/health/live")
                addresses.append(answer.extensions["network_stream"].get_extra_info("client_addr"))

    with pytest.raises(Started):
        launch(tmp_path, ask_twice)
    assert addresses[0] == addresses[1]


HEAD = b"ply\nformat ascii 1.0\n"
UPLOAD = b"POST /scans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/octet-stream\r\nContent-Length: %d\r\n\r\n"


def test_an_upload_that_runs_when_the_end_is_asked_for_may_end(tmp_path: Path) -> None:
    robots: list[threading.Thread] = []
    said: list[bytes] = []

    def upload(connection: socket.socket) -> None:
        with connection:
            time.sleep(3)  # longer than anything is waited for by default
            connection.sendall(b"x" * 1000)
            said.append(connection.recv(65536))

    def begin(port: int) -> None:
        connection = socket.create_connection(("127.0.0.1", port))
        connection.sendall(UPLOAD % (len(HEAD) + 1000) + HEAD)
        time.sleep(0.5)
        robots.append(threading.Thread(target=upload, args=(connection,)))
        robots[0].start()

    with pytest.raises(Started):
        launch(tmp_path, begin, shutdown_grace_s=20)
    robots[0].join(10)
    assert said[0].startswith(b"HTTP/1.1 201")


def test_asked_twice_it_waits_for_no_upload(tmp_path: Path) -> None:
    connections: list[socket.socket] = []

    def ask_twice() -> None:
        for _ in range(2):
            time.sleep(0.7)
            os.kill(os.getpid(), signal.SIGTERM)

    def begin(running: Running) -> None:
        connections.append(socket.create_connection(("127.0.0.1", int(running.url.rpartition(":")[2]))))
        connections[0].sendall(UPLOAD % 1_000_000 + HEAD)
        threading.Thread(target=ask_twice).start()

    started = time.monotonic()
    up(api_alone(tmp_path, shutdown_grace_s=60), on_ready=begin)
    assert time.monotonic() - started < 15
    connections[0].close()


def test_the_api_knows_its_own_description_before_anybody_asks(tmp_path: Path) -> None:
    assert _app(api_alone(tmp_path)).openapi_schema is not None
