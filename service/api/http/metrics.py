"""Metrics: requests and their latency by route, jobs by state; in a registry of the app's own."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.catalog.records import JobStatus


class Metrics:
    """What is counted."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        labels = ("method", "route")
        self.requests = Counter(
            "spicd_requests", "Requests answered", (*labels, "status"), registry=self.registry
        )
        self.seconds = Histogram(
            "spicd_request_seconds", "Time to the end of the answer", labels, registry=self.registry
        )
        self.jobs = Gauge("spicd_jobs", "Jobs in the catalog", ("status",), registry=self.registry)

    def count_jobs(self, counts: Mapping[str, int]) -> None:
        """Take the number of jobs in each state; those without one are 0."""
        for status in get_args(JobStatus):
            self.jobs.labels(status).set(counts.get(status, 0))


class MetricsMiddleware:
    """Counts every request under its route's template: an id in a label would make a series of each map."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on (ASGI), and count its answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status = 500
        started = time.perf_counter()

        async def note(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, note)
        finally:
            route = getattr(scope.get("route"), "path", "none")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self._metrics.requests.labels(method, route, str(status)).inc()
            self._metrics.seconds.labels(method, route).observe(time.perf_counter() - started)


_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
