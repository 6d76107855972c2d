"""/health and /metrics: what the machines around the service ask."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST

from service.api.http.dependencies import Provided, Services
from service.api.http.documents import Document
from service.api.http.metrics import Metrics
from service.api.http.monitor import HealthMonitor, Part
from service.api.http.problems import documented, response

router = APIRouter(tags=["health"])

Check = Literal["ok", "failed"]

_ELSEWHERE_S = 10.0  #: between two looks at a store that takes money for each


class Live(Document):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Ready(Document):
    """Every part answers."""

    status: Literal["ok"] = "ok"
    checks: dict[str, Check]


def parts(services: Services) -> dict[str, Part]:
    """Return what the service needs, and how each part is asked."""
    blobs = services.catalog.blobs
    return {
        "database": Part(ping=services.catalog.database.ping),
        "queue": Part(ping=services.queue.ping),
        "blobs": Part(ping=blobs.ping, every_s=2.0 if blobs.is_local else _ELSEWHERE_S),
    }


@router.get("/health/live", summary="Is the process alive")
async def live() -> Live:
    """Always, while it answers at all."""
    return Live()


@router.get(
    "/health/ready",
    summary="Can it take work",
    response_model=Ready,
    responses=documented("unhealthy"),
)
async def ready(request: Request) -> Ready | Response:
    """What the database, the queue and the blob store said when they were asked last, some seconds ago at most.

    `reasons` says of each part that failed why. Never waits for one of them.
    """
    monitor: HealthMonitor = request.app.state.monitor
    failures = monitor.failures()
    checks: dict[str, Check] = {name: "failed" if why else "ok" for name, why in failures.items()}
    reasons = {name: why for name, why in failures.items() if why}
    if reasons:
        detail = f"no answer from: {', '.join(reasons)}"
        return response("unhealthy", detail, checks=checks, reasons=reasons)
    return Ready(checks=checks)


@router.get("/metrics", summary="Metrics for Prometheus", response_class=Response)
def metrics(request: Request, services: Provided) -> Response:
    """Requests by route, and what the catalog, the disk and the queue tell."""
    counted: Metrics = request.app.state.metrics
    text = counted.text(services.catalog, services.settings.data_dir, services.queue.snapshot)
    return Response(text, media_type=CONTENT_TYPE_LATEST)
