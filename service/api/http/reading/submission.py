"""From a request to a job: keep the files, record, submit; and when the queue is down, keep nothing."""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Annotated, Any, ParamSpec, Self

from fastapi import Request as HttpRequest
from pydantic import BaseModel, BeforeValidator, Field

from service import tracing
from service.api.http.answering.documents import Link, Request, link
from service.api.http.dependencies import Services
from service.api.http.guards.lanes import Lane
from service.api.http.reading.bodies import Body
from service.api.http.reading.fields import MAX_LISTED, DeviceId, Instant, Pose, ScanId, names_from_text
from service.api.http.reading.idempotency import answered
from service.catalog.catalog import Catalog
from service.catalog.idempotency import ANY_TIMES, Answer, Once
from service.catalog.records import JobRecord, Matrix, ScanRecord
from service.dispatch import Dispatcher
from service.errors import QueueFull, QueueUnavailable, ServiceError, Unavailable
from service.logs import about

log = logging.getLogger(__name__)

P = ParamSpec("P")

LOOK_AGAIN_S = 2  #: seconds after which it makes sense to ask how far a job is


class ScanUse(Request):
    """A scan that was uploaded before, with what counts in this map or survey alone."""

    scan_id: ScanId
    pose: Annotated[
        Pose | None,
        Field(description="4x4 row-major, map_from_sensor, in place of the upload's; left out: the upload's"),
    ] = None


class ScansRequest(Request):
    """Scans that were uploaded before; others may come with the request."""

    scan_ids: Annotated[
        tuple[ScanId, ...], Field(max_length=MAX_LISTED), BeforeValidator(names_from_text)
    ] = ()
    scans: Annotated[
        tuple[ScanUse, ...],
        Field(max_length=MAX_LISTED, description="further scans, each with a pose that counts here alone"),
    ] = ()
    captured_at: Annotated[Instant | None, Field(description="of the files in this request")] = None
    device_id: Annotated[DeviceId | None, Field(description="of the files in this request")] = None

    @property
    def poses(self) -> dict[str, Matrix]:
        """Those that count in this map or survey alone, by the id of the scan."""
        return {use.scan_id: use.pose for use in self.scans if use.pose is not None}


@contextlib.contextmanager
def kept_scans(catalog: Catalog, body: Body, wanted: ScansRequest) -> Iterator[tuple[str, ...]]:
    """Give the ids of the scans of a request: those named, then the files it brought, each once.

    When the block raises, files that were new are forgotten again.
    """
    new: list[ScanRecord] = []
    ids = [*wanted.scan_ids, *(use.scan_id for use in wanted.scans)]
    try:
        for upload in body.uploads:
            scan, is_new = catalog.scans.add(
                **asdict(upload), device_id=wanted.device_id, captured_at=wanted.captured_at
            )
            if is_new:
                new.append(scan)
            if scan.scan_id not in ids:
                ids.append(scan.scan_id)
        yield tuple(ids)
    except BaseException:
        for scan in new:
            catalog.scans.take_back(scan)
        raise


def monitor(request: HttpRequest, job: JobRecord) -> Link:
    """Return the link to a job that was submitted."""
    return link(request, f"/jobs/{job.job_id}", "monitor")


#: For `responses` of a route that submits a job.
SUBMITTED: dict[int | str, dict[str, Any]] = {
    202: {
        "description": "A job does it; `GET /jobs/{job_id}` with `wait` tells when it has ended",
        "headers": {
            "Location": {
                "description": "path of the job",
                "required": True,
                "schema": {"type": "string", "examples": ["/jobs/job-5f0c"]},
            },
            "Retry-After": {
                "description": "seconds after which it makes sense to ask for the job",
                "required": True,
                "schema": {"type": "integer", "examples": [LOOK_AGAIN_S]},
            },
        },
    }
}


def job_headers(request: HttpRequest, job: JobRecord) -> dict[str, str]:
    """Return the headers of the answer to a request that submitted a job."""
    return {"Location": monitor(request, job).href, "Retry-After": str(LOOK_AGAIN_S)}


def accepted(request: HttpRequest, document: BaseModel, job: JobRecord) -> Answer:
    """Return the answer to a request that submitted a job, as it is kept."""
    return answered(document, status=202, headers=job_headers(request, job))


def admit(services: Services, owner: str | None = None) -> None:
    """Make sure that one more job may wait, of an owner or of all. Raises QueueFull."""
    jobs, settings = services.catalog.jobs, services.settings
    if (waiting := jobs.waiting()) >= settings.max_waiting_jobs:
        raise QueueFull(f"{waiting} jobs wait, as many as may; send it again later")
    if owner is not None and (waiting := jobs.waiting(owner)) >= settings.max_waiting_jobs_per_device:
        raise QueueFull(
            f"{waiting} jobs of {owner!r} wait, as many as may of one device; send it again later"
        )


def submit(services: Services, job: JobRecord, *, forget: Callable[[], None], once: Once = ANY_TIMES) -> None:
    """Have a recorded job wait for its turn. Raises QueueUnavailable after `forget` has taken the record back.

    `once` is what the record was made under.
    """
    try:
        services.queue.ping()
        services.dispatcher.hand_over()
    except BaseException:
        forget()
        once.drop()
        raise
    once.settle()
    tracing.link_job(job.job_id)
    with about(job_id=job.job_id):  # the one line that has the ids of request and job
        log.info("the %s job waits", job.kind)


class Ticker:
    """Has the dispatcher compare catalog and queue every second, in a thread of its own; a context manager."""

    def __init__(self, dispatcher: Dispatcher, *, every_s: float = 1.0) -> None:
        self._dispatcher, self._every_s = dispatcher, every_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="dispatch", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(5)

    def _run(self) -> None:
        silenced = False
        while not self._over.is_set():
            try:
                self._dispatcher.run()
                silenced = False
            except Unavailable as error:
                if not silenced:
                    log.warning("jobs cannot be handed over: %s", error)
                silenced = True
            except Exception:
                log.exception("jobs cannot be handed over")
            self._over.wait(self._every_s)


def run_again(services: Services, job_id: str, once: Once = ANY_TIMES) -> JobRecord:
    """Have a failed job wait for its turn again. Raises NotFound, Conflict, QueueFull, QueueUnavailable, DiskFull."""
    once.look()
    services.catalog.disk.require()
    admit(services)
    services.queue.ping()
    job = services.catalog.jobs.run_again(job_id, once=once)
    services.dispatcher.hand_over()
    return job


def dismiss(services: Services, job_id: str) -> JobRecord:
    """Dismiss a job for good, then tell the workers. Raises NotFound and Conflict.

    Without a queue the dismissal still stands: a worker asks the catalog before each step and within it.
    """
    job = services.catalog.jobs.dismiss(job_id)
    try:
        services.queue.dismiss(job.job_id, job.kind)
    except QueueUnavailable as error:
        log.warning("job %s is dismissed, but the queue was not told: %s", job_id, error)
    return job


def lane(services: Services, body: Body) -> Lane:
    """Return the threads in which a request is carried out: files take their time, and hold up no other write."""
    return services.uploads if body.uploads else services.writes


async def delete(services: Services, call: Callable[P, None], *args: P.args, **kwargs: P.kwargs) -> None:
    """Delete something, in a thread, also where no space is left to note that it is gone."""
    await services.writes.run(services.catalog.disk.freeing, functools.partial(call, *args, **kwargs))


def stop_if_open(services: Services, job_id: str) -> None:
    """Dismiss a job whose map or survey is going to be deleted, unless it has ended."""
    with contextlib.suppress(ServiceError):
        dismiss(services, job_id)
