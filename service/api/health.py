"""/health and /metrics: what the machines around the service ask."""

from __future__ import annotations

import functools
from typing import Literal

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import Field

from service.api.http.answering.documents import Document
from service.api.http.answering.problems import documented, response
from service.api.http.dependencies import Provided, Queue, Services
from service.api.http.metrics import Metrics
from service.api.http.monitor import HealthMonitor, Part
from service.errors import QueueUnavailable, Unavailable
from service.queue import QUEUES

router = APIRouter(tags=["health"])

Check = Literal["ok", "failed"]

_ELSEWHERE_S = 10.0  #: between two looks at a store that takes money for each
_WORKERS_START_S = 30.0  #: they are started beside the API, and load their libraries first


class Live(Document):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Ready(Document):
    """Every part that a request needs answers."""

    status: Literal["ok", "degraded"] = Field(
        "ok", description="degraded: it takes work, and workers do not answer, so that jobs wait"
    )
    checks: dict[str, Check]
    reasons: dict[str, str] = Field(default_factory=dict, description="why a check failed")


def parts(services: Services) -> dict[str, Part]:
    """Return what the service needs, and how each part is asked."""
    blobs = services.catalog.blobs
    return {
        "workers": Part(ping=functools.partial(_ask_workers, services.queue), starts_s=_WORKERS_START_S),
        "database": Part(ping=services.catalog.database.ping),
        "queue": Part(ping=services.queue.ping),
        "blobs": Part(ping=blobs.ping, every_s=2.0 if blobs.is_local else _ELSEWHERE_S),
    }


def _ask_workers(queue: Queue) -> None:
    """Return where each queue has a worker that answers and none that is silent. Raises Unavailable.

    Its sentence is open to everybody, so it counts workers: their names are those of hosts and processes.
    """
    try:
        snapshot = queue.snapshot()
    except QueueUnavailable:  # which the part `queue` tells; nothing is known of workers
        return
    wrong = [f"no {name} worker answers" for name in QUEUES if not snapshot[name].answering]
    silent = {name: len(snapshot[name].silent) for name in QUEUES}
    wrong += [f"{number} {name} workers are silent" for name, number in silent.items() if number]
    if wrong:
        raise Unavailable("; ".join(wrong))


@router.get("/health/live", summary="Is the process alive")
async def get_liveness() -> Live:
    """Always, while it answers at all."""
    return Live()


@router.get(
    "/health/ready",
    summary="Can it take work",
    response_model=Ready,
    responses=documented("unhealthy"),
)
async def get_readiness(request: Request) -> Ready | Response:
    """What the database, the queue and the blob store said when they were asked last, some seconds ago at most.

    `reasons` says of each part that failed why. Never waits for one of them. Workers that do not answer make it
    `degraded` and not a 503: a proxy that took the service out would refuse uploads that it can keep.
    """
    monitor: HealthMonitor = request.app.state.monitor
    failures = monitor.failures()
    checks: dict[str, Check] = {name: "failed" if why else "ok" for name, why in failures.items()}
    reasons = {name: why for name, why in failures.items() if why}
    if set(reasons) == {"workers"}:  # requests are answered, and what is accepted is not lost
        return Ready(status="degraded", checks=checks, reasons=reasons)
    if reasons:
        detail = f"no answer from: {', '.join(reasons)}"
        headers = {"Retry-After": str(Unavailable.retry_after_s)}
        return response("unhealthy", detail, headers=headers, checks=checks, reasons=reasons)
    return Ready(checks=checks)


@router.get("/metrics", summary="Metrics for Prometheus", response_class=Response)
def get_metrics(request: Request, services: Provided) -> Response:
    """Requests by route, and what the catalog, the disk and the queue tell."""
    counted: Metrics = request.app.state.metrics
    counted.listeners.set(services.listeners.count)
    text = counted.text(services.catalog, services.settings.data_dir, services.queue.snapshot)
    return Response(text, media_type=CONTENT_TYPE_LATEST)
