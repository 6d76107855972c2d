"""Traces for a collector, where `OTEL_EXPORTER_OTLP_ENDPOINT` names one (OpenTelemetry, OTLP over HTTP).

A span for each request, for each step of a job, and for each stage of a step. All steps of a job are one trace, whose id
follows from the job's: steps run in processes of their own, on any host, and only the job's id is handed on. The span of
the request that submitted a job has a link to that trace.

OpenTelemetry is imported only where a collector is named, and its provider made in the process that has the spans, after
the fork of a step: its thread would not survive one. A collector that is away costs a step a second at most.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import threading
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from opentelemetry.context import Context
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.trace import Span, SpanContext

log = logging.getLogger("spicd.tracing")

_COLLECTORS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")  #: of the specification
_TIMEOUT_S = 3  #: of one export
_FLUSH_S = 1.0  #: that the end of a step waits for its spans to be sent


class Request:
    """The span of a request, or nothing where nobody collects."""

    def __init__(self, span: Span | None) -> None:
        self._span = span

    def answered(self, method: str, route: str, status: int | None, request_id: str) -> None:
        """Name the request by its route, once that is known."""
        if self._span is None:
            return
        self._span.update_name(f"{method} {route}")
        self._span.set_attributes(
            {
                "http.request.method": method,
                "http.route": route,
                "http.response.status_code": status or 0,
                "spicd.request_id": request_id,
            }
        )
        if status is None or status >= 500:
            from opentelemetry.trace import StatusCode  # noqa: PLC0415

            self._span.set_status(StatusCode.ERROR)


class _Step:
    """The span of a step that runs, and that of its stage."""

    def __init__(self, provider: TracerProvider) -> None:
        self._tracer = provider.get_tracer("spicd")
        self._stage: tuple[str, Span] | None = None

    def stage(self, name: str) -> None:
        """End the span of the stage before, and begin that of another."""
        if self._stage is not None and self._stage[0] == name:
            return
        self.end()
        self._stage = name, self._tracer.start_span(f"stage {name}")

    def end(self) -> None:
        """End the span of the last stage."""
        if self._stage is not None:
            self._stage[1].end()


_STEP: ContextVar[_Step | None] = ContextVar("spicd_traced_step", default=None)


@contextlib.contextmanager
def request(headers: Mapping[str, str]) -> Iterator[Request]:
    """Trace a request; a trace that the client began goes on (W3C Trace Context)."""
    provider = _provider(os.getpid())
    if provider is None:
        yield Request(None)
        return
    from opentelemetry.trace import SpanKind  # noqa: PLC0415
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator  # noqa: PLC0415

    given = TraceContextTextMapPropagator().extract(headers)
    tracer = provider.get_tracer("spicd")
    with tracer.start_as_current_span("request", context=given, kind=SpanKind.SERVER) as span:
        yield Request(span)


def link_job(job_id: str) -> None:
    """Link the request that is traced to the trace of a job that it submits."""
    if _provider(os.getpid()) is None:
        return
    from opentelemetry import trace  # noqa: PLC0415

    span = trace.get_current_span()
    span.set_attribute("spicd.job_id", job_id)
    span.add_link(_of_job(job_id))


@contextlib.contextmanager
def step(job_id: str, name: str) -> Iterator[None]:
    """Trace one run of a step; its spans are sent before this ends, for the process may end with it."""
    provider = _provider(os.getpid())
    if provider is None:
        yield
        return
    token = _STEP.set(running := _Step(provider))
    attributes = {"spicd.job_id": job_id, "spicd.step": name}
    tracer = provider.get_tracer("spicd")
    try:
        with tracer.start_as_current_span(f"step {name}", context=_under(job_id), attributes=attributes):
            try:
                yield
            finally:
                running.end()
    finally:
        _STEP.reset(token)
        flush = threading.Thread(target=provider.force_flush, daemon=True)
        flush.start()
        flush.join(_FLUSH_S)


def stage(name: str) -> None:
    """Say that the step which is traced is at a stage; the one before is over."""
    if (running := _STEP.get()) is not None:
        running.stage(name)


@functools.lru_cache(maxsize=1)
def _provider(pid: int) -> TracerProvider | None:
    """Return what makes spans in this process; None where no collector is named."""
    named = next((os.environ[name] for name in _COLLECTORS if os.environ.get(name)), None)
    if named is None or os.environ.get("OTEL_SDK_DISABLED", "").lower() == "true":
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter  # noqa: PLC0415
        from opentelemetry.sdk.resources import Resource  # noqa: PLC0415
        from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
        from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415
    except ImportError:
        log.warning(
            "a collector of traces is named, and nothing to send them with: pip install 'spicd[otel]'"
        )
        return None
    name = os.environ.get("OTEL_SERVICE_NAME", "spicd")
    provider = TracerProvider(resource=Resource.create({"service.name": name, "process.pid": pid}))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(timeout=_TIMEOUT_S)))
    return provider


def _of_job(job_id: str) -> SpanContext:
    """Return where the trace of a job begins; every process makes the same of its id."""
    from opentelemetry.trace import SpanContext, TraceFlags  # noqa: PLC0415

    digest = hashlib.sha256(job_id.encode()).digest()
    trace_id, span_id = int.from_bytes(digest[:16]), int.from_bytes(digest[16:24])
    return SpanContext(trace_id, span_id, is_remote=True, trace_flags=TraceFlags(TraceFlags.SAMPLED))


def _under(job_id: str) -> Context:
    from opentelemetry.trace import NonRecordingSpan, set_span_in_context  # noqa: PLC0415

    return set_span_in_context(NonRecordingSpan(_of_job(job_id)))
