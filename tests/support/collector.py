"""Stands in for an OpenTelemetry collector."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest


@dataclass
class Collector:
    """Keeps the spans that come."""

    url: str = ""
    spans: list[Any] = field(default_factory=list)

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs to send its spans here."""
        return {"OTEL_EXPORTER_OTLP_ENDPOINT": self.url, "OTEL_EXPORTER_OTLP_COMPRESSION": "none"}

    def named(self, name: str) -> Any:
        """The one span of that name, once it has come."""
        until = time.monotonic() + 10
        while time.monotonic() < until and all(span.name != name for span in self.spans):
            time.sleep(0.02)
        (found,) = [span for span in self.spans if span.name == name]
        return found


@contextlib.contextmanager
def collecting() -> Iterator[Collector]:
    """Collect while the block lasts."""
    collected = Collector()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            for resource in ExportTraceServiceRequest.FromString(body).resource_spans:
                for scope in resource.scope_spans:
                    collected.spans.extend(scope.spans)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    collected.url = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield collected
    finally:
        server.shutdown()
        server.server_close()


def attributes(span: Any) -> dict[str, Any]:
    return {one.key: one.value.string_value or one.value.int_value for one in span.attributes}
