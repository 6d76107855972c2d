"""From a request to a job: keep the files, record, submit; and when the queue is down, keep nothing."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Annotated, ParamSpec

from fastapi import Request as HttpRequest
from fastapi import Response
from pydantic import BeforeValidator, Field

from service.api.http.bodies import Body
from service.api.http.dependencies import Services
from service.api.http.documents import Link, Request, link
from service.api.http.fields import DeviceId, Id, Instant, names_from_text
from service.api.http.lanes import Lane
from service.catalog.catalog import Catalog
from service.catalog.records import JobRecord, ScanRecord
from service.errors import QueueUnavailable, ServiceError

log = logging.getLogger(__name__)

P = ParamSpec("P")


class ScansRequest(Request):
    """Scans that were uploaded before; others may come with the request."""

    scan_ids: Annotated[tuple[Id, ...], BeforeValidator(names_from_text), Field(max_length=1000)] = ()
    captured_at: Annotated[Instant | None, Field(description="of the files in this request")] = None
    device_id: Annotated[DeviceId | None, Field(description="of the files in this request")] = None


@contextlib.contextmanager
def kept_scans(catalog: Catalog, body: Body, wanted: ScansRequest) -> Iterator[tuple[str, ...]]:
    """Give the ids of the scans of a request: those named, then the files it brought, each once.

    When the block raises, files that were new are forgotten again.
    """
    new: list[ScanRecord] = []
    ids = list(wanted.scan_ids)
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


def monitor(request: HttpRequest, response: Response, job: JobRecord) -> Link:
    """Return the link to a job that was submitted, which the answer names in `Location` as well."""
    here = link(request, f"/jobs/{job.job_id}", "monitor")
    response.headers["Location"] = here.href
    return here


def submit(services: Services, job: JobRecord, *, forget: Callable[[], None]) -> None:
    """Hand a recorded job to the queue. Raises QueueUnavailable after `forget` has taken the record back."""
    try:
        services.queue.submit(job.job_id, job.kind)
    except BaseException:
        forget()
        raise


def resubmit(services: Services) -> None:
    """Hand over again what the catalog knows as unfinished and the queue does not hold; call when the service starts.

    A job that waits was perhaps never submitted: a process died between the two, or Redis lost it. One that runs has
    lost its worker, and with it an attempt: what takes the whole machine down with it must not do so for ever.
    """
    jobs = services.catalog.jobs
    try:
        for job in jobs.unfinished():
            if services.queue.holds(job.job_id, job.kind):
                continue
            if job.status == "accepted" or jobs.lose_attempt(job.job_id, "the service ended while it ran"):
                services.queue.submit(job.job_id, job.kind)
    except QueueUnavailable as error:
        log.warning("unfinished jobs could not be submitted again: %s", error)


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
