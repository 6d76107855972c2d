"""The app: routes, problems and metrics put together; nothing is opened before it starts."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from importlib.metadata import PackageNotFoundError, version
from threading import Lock
from typing import Any

from fastapi import Depends, FastAPI
from fastapi.concurrency import run_in_threadpool
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import JsonSchemaMode, models_json_schema
from starlette.types import ASGIApp

from service.api import (
    changes,
    health,
    jobs,
    landing,
    maps,
    models,
    objects,
    processes,
    scans,
    surveys,
    tiles,
    tilesets,
    tus,
    versions,
)
from service.api.following import event_documents, events, receivers, webhooks
from service.api.housekeeping import housekeeping
from service.api.http.answering import problems
from service.api.http.answering.cards import Cards
from service.api.http.answering.prefix import PrefixMiddleware
from service.api.http.answering.representations import RepresentationMiddleware, add_conditions
from service.api.http.dependencies import Queue, Services
from service.api.http.description import mended, operation_id
from service.api.http.docs_pages import add_pages
from service.api.http.guards.access import authorize, secured
from service.api.http.guards.cross_site import add_cross_site_checks
from service.api.http.guards.lanes import UPLOAD_TURN_S, Lane
from service.api.http.guards.listeners import Listeners
from service.api.http.guards.methods import MethodsMiddleware
from service.api.http.guards.security_headers import SecurityHeadersMiddleware
from service.api.http.metrics import Metrics, MetricsMiddleware
from service.api.http.monitor import HealthMonitor
from service.api.http.reading import idempotency
from service.api.http.reading.bodies import INCOMING
from service.api.http.reading.known_query import refuse_unknown
from service.api.http.reading.requests import RequestLog
from service.api.http.reading.submission import Ticker
from service.api.http.reading.tus import TusHeaders
from service.api.http.reading.uploads import sweep
from service.catalog.catalog import open_catalog
from service.catalog.sql.patience import REQUESTS
from service.dispatch import Dispatcher
from service.queue import JobQueue
from service.settings import Settings
from service.web.pages import add_viewer
from service.webhooks.deliverer import Deliverer
from service.webhooks.sending import Sender

DESCRIPTION = """\
Upload LiDAR scans of a building, build a reference map of them, and ask, tile by tile and \
object by object, what later visits found changed.

Maps, their versions and surveys are built by jobs: the answer to the POST names the job, \
and `GET /jobs/{id}` says how far it is.
Every error is a problem document (RFC 9457) with a stable `type`.

To wait for a job ask `GET /jobs/{id}?wait=20` until it has ended; `GET /events` and webhooks tell of all.

### In TypeScript

With types of openapi-typescript and openapi-fetch. Some answers come in more than one media type: a client for JSON, \
and one for features, have one type for each answer.

```ts
const api = createClient<paths, "application/json" | "application/problem+json">({ baseUrl });
const features = createClient<paths, "application/geo+json" | "application/problem+json">({ baseUrl });
```

Bytes are typed `string` there. A file is sent as it is by:

```ts
const { data: scan } = await api.POST("/scans", {
  params: { query: { filename: "hall.pcd" } },
  headers: { "Content-Type": "application/octet-stream" },
  body: file as unknown as string,
  bodySerializer: (body) => body,
});
```
"""


_SWEEP_EVERY_S = 600.0

#: What FastAPI does not see, for it is read or written by hand: bodies of requests, problems, features.
UNSEEN: dict[JsonSchemaMode, tuple[type[BaseModel], ...]] = {
    "validation": (
        scans.ScanRequest,
        maps.MapRequest,
        versions.VersionRequest,
        maps.AnchorRequest,
        surveys.SurveyRequest,
        models.TrainingRequest,
        webhooks.WebhookRequest,
        webhooks.WebhookChange,
    ),
    "serialization": (
        problems.ProblemDocument,
        tiles.TileCollection,
        tiles.FgTileCollection,
        *objects.DOCUMENTS,
        events.EventList,
        event_documents.WebhookEvent,
    ),
}


class Api(FastAPI):
    """FastAPI with our own description of itself, a line in the log for each request, and security headers."""

    under: str = ""  #: the path that something in front has the API under

    def __init__(self, **settings: Any) -> None:
        self._describing = Lock()
        super().__init__(**settings)

    def build_middleware_stack(self) -> ASGIApp:
        """Return the app; log and headers lie around it all, for unexpected errors are answered outside of middleware."""
        stack = PrefixMiddleware(super().build_middleware_stack(), self.under)
        return RequestLog(SecurityHeadersMiddleware(stack))

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document: what FastAPI derives, and the bodies that are read by hand.

        It is made once: pydantic's and FastAPI's making of schemas is not for several threads at a time, and the first
        requests of a page come together.
        """
        with self._describing:
            if self.openapi_schema is None:
                self.openapi_schema = self._described()
            return self.openapi_schema

    def _described(self) -> dict[str, Any]:
        document = get_openapi(
            title=self.title,
            version=self.version,
            summary=self.summary,
            description=self.description,
            routes=self.routes,
            tags=self.openapi_tags,
        )
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for mode, unseen in UNSEEN.items():
            pairs = [(model, mode) for model in unseen]
            _, derived = models_json_schema(pairs, ref_template="#/components/schemas/{model}")
            schemas.update(derived["$defs"])
        for replaced in ("HTTPValidationError", "ValidationError"):  # by problems
            schemas.pop(replaced, None)
        document["webhooks"] = receivers.described()
        add_conditions(document)
        secured(document, problems.documented("unauthorized", "forbidden"))
        _leaving_out(schemas)
        _refusing_unknown(document)
        return mended(document)


def _leaving_out(schemas: dict[str, Any]) -> None:
    """Require no member that comes with one parameter alone, where answers are written by hand.

    These are collections, features and their properties.
    """
    for name, schema in schemas.items():
        members = schema.get("properties", {})
        if "features" in members or "geometry" in members or name.endswith("Properties"):
            alone = {member for member, described in members.items() if described.get("default", "") is None}
            schema["required"] = [member for member in schema["required"] if member not in alone]


def _refusing_unknown(document: dict[str, Any]) -> None:
    """Have every operation name the answer to a query parameter that it does not know."""
    refusal = problems.documented("invalid_request")
    for path in document["paths"].values():
        for operation in path.values():
            for status, answer in refusal.items():
                operation["responses"].setdefault(str(status), answer)


def create_app(settings: Settings, *, queue: Queue | None = None) -> FastAPI:
    """Return the API under `settings`. `queue` is the one to submit to; left out: that at `settings.redis_url`."""
    app = Api(
        title="SPICD",
        version=_version(),
        summary="LiDAR scans in, changed tiles and a coloured cloud out",
        description=DESCRIPTION,
        lifespan=_lifespan(settings, queue),
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=operation_id,
        redirect_slashes=False,  # it would be asked before any key and host, and name a host of the client's choice
        dependencies=[Depends(authorize), Depends(refuse_unknown)],
    )
    app.under = settings.root_path or ""
    app.state.metrics = Metrics()
    app.add_middleware(RepresentationMiddleware)
    app.add_middleware(MethodsMiddleware, routes=app.router.routes)
    add_cross_site_checks(app, settings)
    app.add_middleware(MetricsMiddleware, metrics=app.state.metrics)
    app.add_middleware(TusHeaders)
    problems.add_handlers(app)
    idempotency.add_handler(app)
    add_pages(app)
    add_viewer(app)
    for part in (
        landing,
        scans,
        tus,
        maps,
        versions,
        surveys,
        tiles,
        tilesets,
        changes,
        objects,
        events,
        webhooks,
        jobs,
        processes,
        models,
        health,
    ):
        app.include_router(part.router, responses=None if part in (health, landing) else problems.OUTAGES)
    return app


def _lifespan(settings: Settings, queue: Queue | None) -> Any:
    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        if queue is None and settings.redis_url is None:
            raise ValueError("no SPICD_REDIS_URL: `spicd up` starts an embedded server and sets it")
        used = queue or JobQueue(settings.redis_url or "", timeout_s=settings.job_timeout_s)
        catalog = await run_in_threadpool(open_catalog, settings, patience=REQUESTS)
        dispatcher = Dispatcher(catalog.jobs, used)
        await run_in_threadpool(_sweep, settings)
        sweeping = asyncio.create_task(_go_on_sweeping(settings))
        await run_in_threadpool(catalog.disk.load_ballast)
        app.state.services = Services(
            settings=settings,
            catalog=catalog,
            queue=used,
            dispatcher=dispatcher,
            cards=Cards(settings.model_store, catalog.models),
            writes=Lane(),
            listeners=Listeners(catalog.events, most=settings.max_listeners),
            uploads=Lane(turn_s=UPLOAD_TURN_S),
        )
        app.state.receiver = tus.Receiver(settings)
        app.state.monitor = HealthMonitor(health.parts(app.state.services))
        await run_in_threadpool(app.state.monitor.start)
        ticker = Ticker(dispatcher)
        await run_in_threadpool(ticker.__enter__)
        sender = Sender(allowed=settings.webhook_networks(), root=settings.root_path or "")
        deliverer = Deliverer(catalog.deliveries, sender)
        await run_in_threadpool(deliverer.__enter__)
        try:
            async with housekeeping(app.state.services):
                yield
        finally:
            app.state.services.listeners.end()
            await run_in_threadpool(deliverer.__exit__)
            await run_in_threadpool(ticker.__exit__)
            sweeping.cancel()
            app.state.monitor.stop()
            catalog.close()

    return lifespan


async def _go_on_sweeping(settings: Settings) -> None:
    while True:
        await asyncio.sleep(_SWEEP_EVERY_S)
        with contextlib.suppress(OSError):  # the disk is away; next time
            await run_in_threadpool(_sweep, settings)


def _sweep(settings: Settings) -> None:
    """Remove what uploads of killed processes left, and resumable ones that have expired."""
    sweep(settings.data_dir / INCOMING, upload_timeout_s=settings.upload_timeout_s)
    tus.Receiver(settings).uploads.sweep()


def _version() -> str:
    try:
        return version("spicd")
    except PackageNotFoundError:  # run from a checkout
        return "0"
