"""/health and /metrics: what the machines around the service ask."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Literal

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST

from service.api.http.dependencies import Provided
from service.api.http.documents import Document
from service.api.http.metrics import Metrics
from service.api.http.problems import documented, response

log = logging.getLogger(__name__)
router = APIRouter(tags=["health"])

Check = Literal["ok", "failed"]


class Live(Document):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Ready(Document):
    """Every part answers."""

    status: Literal["ok"] = "ok"
    checks: dict[str, Check]


@router.get("/health/live", summary="Is the process alive")
def live() -> Live:
    """Always, while it answers at all."""
    return Live()


@router.get(
    "/health/ready",
    summary="Can it take work",
    response_model=Ready,
    responses=documented("unhealthy"),
)
def ready(services: Provided) -> Ready | Response:
    """Asks the database, the queue and the blob store."""
    parts: dict[str, Callable[[], None]] = {
        "database": services.catalog.database.ping,
        "queue": services.queue.ping,
        "blobs": services.catalog.blobs.ping,
    }
    checks = {name: _check(name, ping) for name, ping in parts.items()}
    failed = [name for name, check in checks.items() if check == "failed"]
    if failed:
        return response("unhealthy", f"no answer from: {', '.join(failed)}", checks=checks)
    return Ready(checks=checks)


@router.get("/metrics", summary="Metrics for Prometheus", response_class=Response)
def metrics(request: Request, services: Provided) -> Response:
    """Requests by route, and what the catalog, the disk and the queue tell."""
    counted: Metrics = request.app.state.metrics
    text = counted.text(services.catalog, services.settings.data_dir, services.queue.snapshot)
    return Response(text, media_type=CONTENT_TYPE_LATEST)


def _check(name: str, ping: Callable[[], None]) -> Check:
    try:
        ping()
    except Exception:  # whatever it is, this part does not answer
        log.warning("the %s does not answer", name, exc_info=True)
        return "failed"
    return "ok"
