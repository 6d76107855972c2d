"""Slow and silent clients against a real server: each is ended by its clock, and a slow upload that goes on is not."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn

from service.api.app import create_app
from service.up.connections import Limits, limited_protocol
from tests.support.processes import until
from tests.support.samples import RememberingQueue, settings_in

UPLOAD = b"POST /scans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/octet-stream\r\nContent-Length: %d\r\n\r\n"
HEAD = b"ply\nformat ascii 1.0\n"
LIMITS = Limits(
    connections=12,
    header_s=0.6,
    body_window_s=0.6,
    body_bytes=600,
    linger_s=0.8,
    write_s=0.6,
    close_s=0.2,
)


class Server:
    """The API on a port of its own, in a thread."""

    def __init__(self, folder: Path, limits: Limits, **given: Any) -> None:
        self.settings = settings_in(folder).model_copy(update={"max_upload_bytes": 50_000_000, **given})
        self.app = create_app(self.settings, queue=RememberingQueue())
        config = uvicorn.Config(
            self.app, http=limited_protocol(limits), ws="none", log_config=None, timeout_keep_alive=1
        )
        self.server = uvicorn.Server(config)
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        self.thread = threading.Thread(
            target=self.server.run, kwargs={"sockets": [self.listening]}, daemon=True
        )
        self.thread.start()
        until(lambda: self.server.started)

    def connect(self) -> socket.socket:
        connection = socket.create_connection(("127.0.0.1", self.port))
        connection.settimeout(10)
        return connection

    def open_connections(self) -> int:
        return len(self.server.server_state.connections)

    def incoming(self) -> list[Path]:
        folder = self.settings.data_dir / "incoming"
        return list(folder.iterdir()) if folder.exists() else []

    def answers(self) -> bool:
        return httpx.get(f"http://127.0.0.1:{self.port}/health/live", timeout=5).status_code == 200

    def end(self) -> None:
        self.server.should_exit = True
        self.thread.join(10)
        self.listening.close()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    started = Server(tmp_path, LIMITS)
    yield started
    started.end()


def everything(connection: socket.socket) -> bytes:
    """What the server says until it closes, or resets."""
    said = b""
    with contextlib.suppress(ConnectionError):
        while piece := connection.recv(65536):
            said += piece
    return said


def drip(connection: socket.socket, data: bytes, every_s: float, stop: Callable[[], bool]) -> None:
    """Send a byte at a time until the server has closed, or `stop` says so."""
    with contextlib.suppress(OSError):
        for byte in data:
            if stop():
                return
            connection.sendall(bytes([byte]))
            time.sleep(every_s)


def closed_after(connection: socket.socket) -> float:
    started = time.monotonic()
    everything(connection)
    return time.monotonic() - started


def test_a_connection_that_says_nothing_is_closed(server: Server) -> None:
    with server.connect() as connection:
        assert closed_after(connection) == pytest.approx(LIMITS.header_s, abs=0.4)
    until(lambda: server.open_connections() == 0)


@pytest.mark.parametrize("sent", [b"GET /health/live HTTP/1.1\r\nHost: localhost\r\nX: ", b"\r\n" * 100])
def test_a_header_that_comes_byte_by_byte_is_cut_off(server: Server, sent: bytes) -> None:
    with server.connect() as connection:
        started = time.monotonic()
        threading.Thread(target=drip, args=(connection, sent + b"x" * 200, 0.05, lambda: False)).start()
        everything(connection)
        assert time.monotonic() - started < LIMITS.header_s + 0.5


def test_a_header_that_bad_wi_fi_holds_up_for_half_a_minute_is_waited_for() -> None:
    assert Limits().header_s > 30


def test_a_header_behind_an_answered_request_has_the_same_limit(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(b"GET /health/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(lambda: b'"ok"' in connection.recv(65536))
        connection.sendall(b"GET /hea")
        assert b"408" in everything(connection)
    until(lambda: server.open_connections() == 0)


@pytest.mark.parametrize("filler", [17_000, 200_000])
def test_a_header_that_is_too_long_is_refused(server: Server, filler: int) -> None:
    for head in (
        b"GET /health/live?%b HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nX: %b\r\n\r\n",
    ):
        with server.connect() as connection:
            with contextlib.suppress(OSError):
                connection.sendall(head % (b"x" * filler))
            said = everything(connection)
        # who still sends when the connection closes may not get to read why
        assert said.startswith(b"HTTP/1.1 431") or (filler > 100_000 and not said)
    assert server.answers()


def test_a_long_header_that_is_short_enough_is_read_with_its_body(server: Server) -> None:
    body = HEAD + b"x" * 100_000
    head = (UPLOAD % len(body))[:-2] + b"X: " + b"x" * 15_000 + b"\r\n\r\n"
    with server.connect() as connection:
        connection.sendall(head + body)
        assert connection.recv(65536).startswith(b"HTTP/1.1 201")


def test_a_body_of_a_byte_now_and_then_is_ended_and_leaves_nothing(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(UPLOAD % 1_000_000 + HEAD)
        until(server.incoming)
        threading.Thread(target=drip, args=(connection, b"x" * 400, 0.02, lambda: False)).start()
        started = time.monotonic()
        assert b"408" in everything(connection)
        assert time.monotonic() - started < 2 * LIMITS.body_window_s + 1
    until(lambda: not server.incoming())
    until(lambda: server.open_connections() == 0)


def test_a_body_that_stops_is_ended_and_leaves_nothing(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(UPLOAD % 1_000_000 + HEAD + b"x" * 300_000)
        until(server.incoming)
        assert b"408" in everything(connection)
    until(lambda: not server.incoming())


def test_a_slow_upload_that_goes_on_arrives(server: Server) -> None:
    body = HEAD + b"x" * 6000
    with server.connect() as connection:
        connection.sendall(UPLOAD % len(body))
        for start in range(0, len(body), 200):  # 2 kB/s for 3 s, over several windows
            connection.sendall(body[start : start + 200])
            time.sleep(0.1)
        assert connection.recv(65536).startswith(b"HTTP/1.1 201")
    assert not server.incoming()


def test_a_body_that_takes_longer_than_any_may_is_told_so(tmp_path: Path) -> None:
    server = Server(tmp_path, LIMITS, upload_timeout_s=1)
    try:
        with server.connect() as connection:
            connection.sendall(UPLOAD % 1_000_000 + HEAD)
            threading.Thread(target=drip, args=(connection, b"x" * 4000, 0.0005, lambda: False)).start()
            said = everything(connection)
        assert said.startswith(b"HTTP/1.1 408")
        assert b"urn:spicd:problem:too_slow" in said
        until(lambda: not server.incoming())
    finally:
        server.end()


def test_who_goes_on_sending_behind_a_refusal_is_cut_off(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(UPLOAD % 90_000_000)  # more than is taken
        assert connection.recv(65536).startswith(b"HTTP/1.1 413")
        started = time.monotonic()
        with contextlib.suppress(OSError):
            while time.monotonic() - started < 5:
                connection.sendall(b"x" * 1000)
                time.sleep(0.02)
        assert time.monotonic() - started < LIMITS.linger_s + 1
    until(lambda: server.open_connections() == 0)


def test_an_answer_that_nobody_reads_is_dropped(server: Server) -> None:
    async def endless(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        until_s = time.monotonic() + 10
        while time.monotonic() < until_s and server.open_connections():
            await send({"type": "http.response.body", "body": b"x" * 1_000_000, "more_body": True})
            await asyncio.sleep(0)

    server.server.config.loaded_app = endless
    with server.connect() as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(lambda: server.open_connections() == 1)
        until(lambda: server.open_connections() == 0, seconds=5)


def test_a_crowd_of_silent_clients_does_not_keep_others_out(server: Server) -> None:
    patient = Limits(connections=12, header_s=30)
    crowd: list[socket.socket] = []
    server.server.config.http_protocol_class = limited_protocol(patient)
    try:
        for _ in range(60):
            crowd.append(server.connect())
        assert {one.recv(1) for one in crowd[:40]} == {b""}  # the oldest were closed
        until(lambda: server.open_connections() <= patient.connections, seconds=5)
        assert all(server.answers() for _ in range(5))
    finally:
        for connection in crowd:
            connection.close()


def test_a_crowd_that_goes_on_sending_behind_refusals_does_not_keep_others_out(server: Server) -> None:
    server.server.config.http_protocol_class = limited_protocol(Limits(connections=6, linger_s=30))
    crowd = [server.connect() for _ in range(6)]
    try:
        for connection in crowd:
            connection.sendall(UPLOAD % 90_000_000)  # more than is taken
            assert connection.recv(65536).startswith(b"HTTP/1.1 413")
            connection.sendall(b"x")
        time.sleep(0.2)
        assert all(server.answers() for _ in range(5))
    finally:
        for connection in crowd:
            connection.close()


def test_where_every_connection_is_at_work_one_more_is_told_to_come_again(server: Server) -> None:
    server.server.config.http_protocol_class = limited_protocol(Limits(connections=3))
    busy = [server.connect() for _ in range(3)]
    try:
        for connection in busy:
            connection.sendall(UPLOAD % 1_000_000 + HEAD)
        until(lambda: len(server.incoming()) == 3)
        with server.connect() as one_more:
            one_more.sendall(b"GET /health/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
            said = everything(one_more)
        assert re.match(rb"HTTP/1.1 503 .*\r\n(.*\r\n)*Retry-After: 10\r\n", said) or said == b""
    finally:
        for connection in busy:
            connection.close()
    until(lambda: not server.incoming())


def test_idle_connections_of_a_client_that_comes_again_are_kept_for_a_moment(server: Server) -> None:
    with httpx.Client(base_url=f"http://127.0.0.1:{server.port}") as client:
        for _ in range(3):
            assert client.get("/health/live").status_code == 200
        assert server.open_connections() == 1
    until(lambda: server.open_connections() == 0)


def problem_of(said: bytes) -> tuple[int, dict[str, str], Any]:
    """The status, the headers and the document of an answer as it came over the wire."""
    head, _, body = said.partition(b"\r\n\r\n")
    first, *lines = head.decode().split("\r\n")
    headers = dict(line.lower().split(": ", 1) for line in lines)
    assert len(body) == int(headers["content-length"])
    assert headers["content-type"] == "application/problem+json"
    assert headers["connection"] == "close"
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"
    status = int(first.split()[1])
    document = json.loads(body)
    assert document["status"] == status
    return status, headers, document


@pytest.mark.parametrize(
    "sent",
    [
        b"hello\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",  # no Host
        b"GET / HTTP/1.1\r\nHost: localhost\r\nbad header\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: a\x00b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"POST /scans HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\nx",
        b"POST /scans HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\nx",
        b"POST /scans HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: gzip\r\n\r\nx",
        b"POST /scans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/octet-stream\r\n"
        b"Transfer-Encoding: chunked\r\n\r\nno-size\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",  # TLS to a port without
    ],
)
def test_what_is_no_http_is_told_so_in_a_problem(server: Server, sent: bytes) -> None:
    with server.connect() as connection:
        connection.sendall(sent)
        status, _, document = problem_of(everything(connection))
    assert (status, document["type"]) == (400, "urn:spicd:problem:broken_request")
    assert document["detail"]
    assert server.answers()
    until(lambda: not server.incoming())


def test_broken_http_behind_a_sound_request_is_told_too(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(b"GET /health/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(lambda: b'"ok"' in connection.recv(65536))
        connection.sendall(b"nonsense\r\n\r\n")
        assert problem_of(everything(connection))[0] == 400


def test_who_ends_within_a_body_and_listens_is_told_that_nothing_was_kept(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(UPLOAD % 1_000_000 + HEAD)
        until(server.incoming)
        connection.shutdown(socket.SHUT_WR)
        status, _, document = problem_of(everything(connection))
    assert (status, document["type"]) == (400, "urn:spicd:problem:incomplete_body")
    until(lambda: not server.incoming())
    listed = httpx.get(f"http://127.0.0.1:{server.port}/scans", timeout=5).json()
    assert listed["scans"] == []


def test_slow_and_long_requests_are_told_so_in_a_problem(server: Server) -> None:
    for sent, status, code in (
        (b"GET /hea", 408, "too_slow"),
        (UPLOAD % 1_000_000 + HEAD, 408, "too_slow"),
        (b"GET / HTTP/1.1\r\nX: " + b"x" * 17_000, 431, "header_too_large"),
    ):
        with server.connect() as connection:
            connection.sendall(sent)
            told = problem_of(everything(connection))
        assert (told[0], told[2]["type"]) == (status, f"urn:spicd:problem:{code}")
    until(lambda: not server.incoming())


def test_head_and_304_go_over_the_wire_without_content(server: Server) -> None:
    with httpx.Client(base_url=f"http://127.0.0.1:{server.port}") as client:
        get = client.get("/openapi.json")
        head = client.head("/openapi.json")
        again = client.get("/openapi.json", headers={"If-None-Match": get.headers["ETag"]})
        options = client.options("/maps")
        assert (head.status_code, head.content) == (200, b"")
        assert head.headers["Content-Length"] == get.headers["Content-Length"]
        assert (again.status_code, again.content) == (304, b"")
        assert options.headers["Allow"] == "GET, HEAD, POST, OPTIONS"
        assert server.open_connections() == 1  # each answer ended where the next one begins


def test_options_of_the_server_as_a_whole(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(b"OPTIONS * HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert everything(connection).startswith(b"HTTP/1.1 204")
