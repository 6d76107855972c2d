"""Metrics: requests by route, counted in this process; and what the database knows, read at each scrape.

Workers are processes that come and go, so what they count lies in the database (`service.catalog.tallies`), and every
API of a deployment says the same of it: scrape one, or take the largest.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.catalog import tallies
from service.catalog.catalog import Catalog
from service.catalog.following.deliveries import Backlog
from service.catalog.jobs import OpenSteps
from service.catalog.records import JobStatus, WebhookStatus
from service.catalog.sql.tables import now
from service.catalog.steps import STEPS
from service.queue import Snapshot

log = logging.getLogger(__name__)

_REMEMBERED_S = 15.0  #: how old the number of jobs by status may be


#: Asks what the queues hold, and which workers answer. Raises QueueUnavailable.
Look = Callable[[], Snapshot]


class Metrics:
    """What is counted in this process."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        labels = ("method", "route")
        self.requests = Counter(
            "spicd_requests", "Requests answered", (*labels, "status"), registry=self.registry
        )
        self.seconds = Histogram(
            "spicd_request_seconds", "Time to the end of the answer", labels, registry=self.registry
        )
        self.listeners = Gauge(
            "spicd_event_listeners",
            "Streams of events that are open, and lists that wait",
            registry=self.registry,
        )

        self._by_status: tuple[float, dict[str, int]] = (-_REMEMBERED_S, {})

    def text(self, catalog: Catalog, data_dir: Path, look: Look) -> bytes:
        """Return all metrics in Prometheus' text format; what cannot be read is left out."""
        whole = CollectorRegistry()
        whole.register(_Collector(catalog, data_dir, look, lambda: self._counts(catalog)))
        return generate_latest(self.registry) + generate_latest(whole)

    def _counts(self, catalog: Catalog) -> dict[str, int]:
        """Count jobs by status, seldom: that goes through all of them, 6 ms for 100,000."""
        counted, counts = self._by_status
        if time.monotonic() - counted >= _REMEMBERED_S:
            counts = catalog.jobs.counts()
            self._by_status = time.monotonic(), counts
        return counts


class _Collector:
    """Reads the catalog, the disk and the workers for one scrape (prometheus_client's custom collectors)."""

    def __init__(
        self,
        catalog: Catalog,
        data_dir: Path,
        look: Look,
        counts: Callable[[], dict[str, int]],
    ) -> None:
        self._catalog, self._data_dir, self._look, self._counts = catalog, data_dir, look, counts

    def describe(self) -> Iterable[Metric]:
        """Tell nothing in advance: the registry is made for one scrape."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Read everything; what fails is told as a part that is down, and the rest is read all the same."""
        up = GaugeMetricFamily(
            "spicd_part_up", "Whether a part could be read at this scrape", labels=("part",)
        )
        parts: dict[str, Callable[[], list[Metric]]] = {
            "database": self._database,
            "disk": self._disk,
            "queue": self._workers,
        }
        for part, read in parts.items():
            try:
                yield from read()
            except Exception as error:  # whatever it is: a scrape tells what can be told
                log.warning("metrics: the %s could not be read (%s)", part, type(error).__name__)
                up.add_metric((part,), 0)
            else:
                up.add_metric((part,), 1)
        yield up

    def _database(self) -> list[Metric]:
        with self._catalog.database.read() as session:
            samples = tallies.read(session)
        return [
            _by_status(self._counts()),
            *_of_steps(self._catalog.jobs.open_steps(), now()),
            *_of_tallies(samples),
            *_of_webhooks(self._catalog.deliveries.backlog()),
        ]

    def _disk(self) -> list[Metric]:
        usage = shutil.disk_usage(self._data_dir)
        families = GaugeMetricFamily("spicd_disk_bytes", "Disk of the data folder", labels=("state",))
        for state, size in (("free", usage.free), ("total", usage.total)):
            families.add_metric((state,), size)
        return [families]

    def _workers(self) -> list[Metric]:
        family = GaugeMetricFamily(
            "spicd_workers", "Workers by whether they answer", labels=("queue", "state")
        )
        models = GaugeMetricFamily(
            "spicd_inference_models_warm", "Models that the workers that answer keep open"
        )
        size = GaugeMetricFamily("spicd_inference_models_warm_bytes", "Weights of these models")
        for queue, held in self._look().queues.items():
            family.add_metric((queue, "answering"), len(held.answering))
            family.add_metric((queue, "silent"), len(held.silent))
            if queue == "inference":
                models.add_metric((), held.models)
                size.add_metric((), held.model_bytes)
        return [family, models, size]


def _by_status(counts: dict[str, int]) -> Metric:
    family = GaugeMetricFamily("spicd_jobs", "Jobs in the catalog", labels=("status",))
    for status in get_args(JobStatus):
        family.add_metric((status,), counts.get(status, 0))
    return family


def _of_steps(steps: Iterable[OpenSteps], instant: datetime) -> list[Metric]:
    """Tell what waits and what runs; a queue and kind of which nothing does is 0."""
    labels = ("queue", "kind")
    depth = GaugeMetricFamily("spicd_queue_depth", "Steps that wait for a worker", labels=labels)
    wait = GaugeMetricFamily(
        "spicd_queue_oldest_wait_seconds", "How long the oldest has waited", labels=labels
    )
    running = GaugeMetricFamily("spicd_steps_running", "Steps that a worker has begun", labels=labels)
    longest = GaugeMetricFamily(
        "spicd_steps_running_oldest_seconds", "How long the oldest has run", labels=labels
    )
    known: dict[tuple[bool, str, str], tuple[int, float]] = {}
    for one in steps:
        key = (one.waits, _queue(one), one.kind)
        count, oldest = known.get(key, (0, 0.0))
        known[key] = count + one.count, max(oldest, (instant - one.since).total_seconds())
    for kind, of_kind in STEPS.items():
        for queue in sorted({step.queue for step in of_kind}):
            for waits, number, age in ((True, depth, wait), (False, running, longest)):
                count, oldest = known.get((waits, queue, kind), (0, 0.0))
                number.add_metric((queue, kind), count)
                age.add_metric((queue, kind), oldest)
    return [depth, wait, running, longest]


def _of_webhooks(backlog: Backlog) -> list[Metric]:
    """Tell how many webhooks there are, and what waits for them."""
    webhooks = GaugeMetricFamily("spicd_webhooks", "Webhooks by whether they are sent to", labels=("status",))
    for status in get_args(WebhookStatus):
        webhooks.add_metric((status,), backlog.webhooks.get(status, 0))
    waiting = GaugeMetricFamily(
        "spicd_webhook_events_waiting",
        "Events that active webhooks have still to get, of each ten thousand at most",
        value=backlog.events,
    )
    return [webhooks, waiting]


def _queue(one: OpenSteps) -> str:
    steps = STEPS[one.kind]
    return next((step.queue for step in steps if step.name == one.step), steps[0].queue)


def _of_tallies(samples: Iterable[tallies.Sample]) -> list[Metric]:
    """Tell every measure, also those of which nothing was counted yet."""
    counted: dict[str, dict[tuple[str, ...], tuple[int, float]]] = {
        measure.name: dict.fromkeys(measure.expected, (0, 0.0)) for measure in tallies.MEASURES
    }
    labels = {measure.name: measure.labels for measure in tallies.MEASURES}
    for sample in samples:
        if sample.name in counted:  # those of another release are left out
            values = tuple(sample.labels.get(label, "") for label in labels[sample.name])
            counted[sample.name][values] = sample.count, sample.total
    return [_family(measure, counted[measure.name]) for measure in tallies.MEASURES]


def _family(measure: tallies.Measure, counted: Mapping[tuple[str, ...], tuple[int, float]]) -> Metric:
    if measure.summary:
        summary = SummaryMetricFamily(measure.name, measure.help, labels=measure.labels)
        for values, (count, total) in counted.items():
            summary.add_metric(values, count_value=count, sum_value=total)
        return summary
    counter = CounterMetricFamily(measure.name, measure.help, labels=measure.labels)
    for values, (_, total) in counted.items():
        counter.add_metric(values, total)
    return counter


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
            if route not in _WAITING:
                self._metrics.seconds.labels(method, route).observe(time.perf_counter() - started)


_WAITING = frozenset({"/events"})  #: answered when something happens: how long that took says nothing
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
