"""Receivers of webhooks: HTTP servers on the loopback address that remember what came."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

from standardwebhooks import Webhook


@dataclass(frozen=True)
class Received:
    """One request."""

    headers: dict[str, str]
    body: bytes

    @property
    def event(self) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self.body)
        return told

    def verified(self, secret: str) -> dict[str, Any]:
        """The event, by the standard's own library. Raises WebhookVerificationError."""
        told: dict[str, Any] = Webhook(secret).verify(self.body, self.headers)
        return told


@dataclass
class Receiver:
    """Answers with the next of `answers`, and with 204 where there is none; a context manager."""

    answers: list[int] = field(default_factory=list)
    headers: dict[str, str] = field(default_factory=dict)
    before_answer: Callable[[], object] = lambda: None
    received: list[Received] = field(default_factory=list)
    most_at_once: int = 0

    def __enter__(self) -> Self:
        receiver, lock, at_once = self, threading.Lock(), [0]

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                with lock:
                    at_once[0] += 1
                    receiver.most_at_once = max(receiver.most_at_once, at_once[0])
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.before_answer()
                with lock:
                    at_once[0] -= 1
                    receiver.received.append(Received(dict(self.headers.items()), body))
                    status = receiver.answers.pop(0) if receiver.answers else 204
                self.send_response(status)
                for name, value in receiver.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}/hooks?of=lobby"

    def ids(self) -> list[str]:
        """The ids under which events came."""
        return [one.headers["webhook-id"] for one in self.received]

    def subjects(self) -> list[str]:
        return [one.event["subject"] for one in self.received]
