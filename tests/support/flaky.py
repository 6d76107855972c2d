"""A small service behind a bad network: connections break before, while and after it works; now and then it is busy."""

from __future__ import annotations

import hashlib
import itertools
import json
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

Answer = tuple[int, dict[str, str], bytes]

CLOUD = bytes(range(256)) * 4096  #: 1 MiB, a result to be downloaded
FEATURES = [
    {
        "id": f"change-{number}",
        "properties": {"tile_id": "tile_007_003_002", "center": [0, 0, 1], "score": 0.9, "updated": False},
    }
    for number in range(25)
]
EVENTS = [
    {"id": f"event-{number:x}", "sequence": str(number), "type": "survey.ready"} for number in range(100, 112)
]


class Flaky:
    """What the service did, and what the network does to the next request.

    Of each three connections one breaks: before the request is looked at, after it was dealt with, or in the midst of
    the answer, in turn. Of each five other requests one is answered with 503 and one with 429, before it is looked at.
    """

    def __init__(self, *, steady: bool = False) -> None:
        self.steady = steady  #: the network is good, and the service idle
        self.made: list[tuple[str, Any]] = []  #: kind, and what the request said
        self.deleted: list[str] = []
        self.keys: dict[str, tuple[bytes, Answer]] = {}
        self.requests = 0
        self.breaks = itertools.cycle(("before", "after", "amid"))
        self.lock = threading.Lock()

    def fate(self) -> str:
        """Say what becomes of the next request: `before after amid busy many` or nothing."""
        with self.lock:
            self.requests += 1
            if self.steady:
                return ""
            if self.requests % 3 == 0:
                return next(self.breaks)
            return {0: "busy", 1: "many"}.get(self.requests % 5, "")

    def answer(self, method: str, target: str, headers: dict[str, str], body: bytes) -> Answer:
        """Deal with a request, once a key."""
        with self.lock:
            key = headers.get("idempotency-key")
            if method != "POST":
                return self._answer(method, target, headers, body)
            assert key is not None
            digest = hashlib.sha256(target.encode() + body).digest()
            if key not in self.keys:
                self.keys[key] = digest, self._answer(method, target, headers, body)
            first, answer = self.keys[key]
            return answer if first == digest else document(422, {"title": "another body"})

    def _answer(self, method: str, target: str, headers: dict[str, str], body: bytes) -> Answer:
        path, query = urlsplit(target).path, parse_qs(urlsplit(target).query)
        match method, path.strip("/").split("/"):
            case "POST", ["scans"]:
                return self._make("scan", hashlib.sha256(body).hexdigest())
            case "POST", ["maps"]:
                return self._make("map", json.loads(body))
            case "POST", ["maps", _, "surveys"]:
                return self._make("survey", json.loads(body))
            case "DELETE", ["scans", scan_id] if scan_id not in self.deleted:
                self.deleted.append(scan_id)
                return 204, {}, b""
            case "GET", parts:
                return self._read(parts, query, headers)
        return not_found(path)

    def _read(self, parts: list[str], query: dict[str, list[str]], headers: dict[str, str]) -> Answer:
        match parts:
            case ["surveys", _, "cloud.ply"]:
                return ranged(CLOUD, headers)
            case ["maps", _, "changes"]:
                start = int(query.get("after", ["0"])[0])
                page = FEATURES[start : start + 4]
                return document(200, {"features": page, "links": [], "cursor": str(start + len(page))})
            case ["maps"]:
                return document(200, {"maps": [{"map_id": "lobby", "name": None}], "links": []})
            case ["jobs", job_id]:
                done = {"jobID": job_id, "status": "successful", "progress": 100, "message": ""}
                return document(200, done)
            case ["events"]:
                return stream(int(headers.get("last-event-id", "99")))
        return not_found("/".join(parts))

    def _make(self, kind: str, said: Any) -> Answer:
        self.made.append((kind, said))
        number = sum(1 for one, _ in self.made if one == kind)
        return document(201, {f"{kind}_id": f"{kind}-{number}", "job_id": "job-1"})


def not_found(path: str) -> Answer:
    return document(404, {"title": "There is no such thing", "detail": path})


def document(status: int, content: Any) -> Answer:
    return status, {"Content-Type": "application/json"}, json.dumps(content).encode()


def stream(last: int) -> Answer:
    """Tell where the stream stands, the next five events, and give a sign of life."""
    rest = [one for one in EVENTS if int(one["sequence"]) > last][:5]
    told = "".join(f"id: {one['sequence']}\ndata: {json.dumps(one)}\n\n" for one in rest)
    alive = f": \nid: {rest[-1]['sequence'] if rest else last}\n\n"
    content = f"retry: 2000\nid: {last}\n\n{told}{alive}"
    return 200, {"Content-Type": "text/event-stream"}, content.encode()


def ranged(content: bytes, headers: dict[str, str]) -> Answer:
    """Answer with a file, or with what is left of it."""
    about = {"ETag": '"one"', "Accept-Ranges": "bytes"}
    asked = headers.get("range")
    if asked is None or headers.get("if-range") != '"one"':
        return 200, about, content
    start = int(asked.removeprefix("bytes=").rstrip("-"))
    return (
        206,
        {**about, "Content-Range": f"bytes {start}-{len(content) - 1}/{len(content)}"},
        content[start:],
    )


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    flaky: Flaky

    def _handle(self) -> None:
        fate = self.flaky.fate()
        if fate == "before":
            return self._break()
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if fate in ("busy", "many"):
            status, more = (503, {}) if fate == "busy" else (429, {"Retry-After": "0"})
            return self._send((status, more, b""), whole=True)
        headers = {name.lower(): value for name, value in self.headers.items()}
        answer = self.flaky.answer(self.command, self.path, headers, body)
        return self._break() if fate == "after" else self._send(answer, whole=fate != "amid")

    do_GET = do_POST = do_DELETE = do_PUT = _handle  # noqa: N815

    def _send(self, answer: Answer, *, whole: bool) -> None:
        status, headers, content = answer
        self.send_response(status)
        for name, value in (headers | {"Content-Length": str(len(content))}).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content if whole else content[: len(content) // 2])
        if not whole:
            self.wfile.flush()
            self.close_connection = True

    def _break(self) -> None:
        """End the connection by a reset, as a link does that is gone."""
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.close_connection = True
        self.connection.close()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def flaky_service(flaky: Flaky) -> Iterator[str]:
    """Serve on a free port; yields the address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"flaky": flaky}))
    server.daemon_threads = True
    server.handle_error = lambda *_: None  # type: ignore[method-assign]
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
