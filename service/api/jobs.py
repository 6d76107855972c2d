"""/jobs: the status of every job (OGC API - Processes - Part 1: Core, OGC 18-062r2)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import Field

from service.api.http.answering.documents import Document, Link, link
from service.api.http.answering.documents import Request as Asked
from service.api.http.answering.paging import PageRequest, list_links
from service.api.http.answering.problems import LISTED, NAMED, JobProblem, documented
from service.api.http.dependencies import Provided, Services
from service.api.http.guards.access import maps_of_key
from service.api.http.reading.fields import Id
from service.api.http.reading.idempotency import KEYED, Keyed
from service.api.http.reading.submission import (
    LOOK_AGAIN_S,
    SUBMITTED,
    accepted,
    dismiss,
    job_headers,
    run_again,
)
from service.api.models import model_path
from service.catalog.following.events import EventFilter
from service.catalog.idempotency import Answer
from service.catalog.records import EventType, JobRecord, JobStatus
from service.catalog.sql.tables import now
from service.catalog.steps import JobKind
from service.dispatch import queue_positions

RESULTS = "http://www.opengis.net/def/rel/ogc/1.0/results"  #: OGC 18-062r2, Section 7.11

router = APIRouter(tags=["jobs"])
JobId = Annotated[Id, Path()]
OPEN = ("accepted", "running")  #: states of a job that has not ended
_EVENTS = 100  #: of jobs that ended, read at a time
_LOOKED_AT: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The job",
        "headers": {
            "Retry-After": {
                "description": "seconds after which to ask again; while it has not ended",
                "schema": {"type": "integer", "examples": [LOOK_AGAIN_S]},
            }
        },
    }
}


class JobsRequest(PageRequest):
    """Which jobs."""

    status: JobStatus | None = None
    map_id: Id | None = None


class JobRequest(Asked):
    """How long to wait."""

    wait: Annotated[
        float, Field(ge=0, le=60, description="seconds that the answer may take while the job has not ended")
    ] = 0


class JobDocument(JobRecord, Document):
    """The status of a job (OGC API - Processes - Part 1, statusInfo), with what it works on."""

    job_id: str = Field(serialization_alias="jobID", examples=["job-5f0c"])  # the standard's name
    kind: JobKind = Field(serialization_alias="processID")  # the standard's name
    type: Literal["process"] = "process"
    problem: JobProblem  # type: ignore[assignment]  # as RFC 9457 has it
    queue_position: int | None = Field(
        None, description="of the step that waits, 1 is next; null while it runs", examples=[1]
    )
    waiting_s: float | None = Field(
        None, description="for how long the step has waited; null while it runs", examples=[0.4]
    )
    links: list[Link]


class JobList(Document):
    """Jobs, newest first."""

    jobs: list[JobDocument]
    links: list[Link]


@router.get("/jobs", summary="List jobs", responses=LISTED)
def list_jobs(request: Request, services: Provided, asked: Annotated[JobsRequest, Query()]) -> JobList:
    """Newest first; a key that is bound to maps sees those of its maps."""
    page = services.catalog.jobs.page(
        status=asked.status,
        map_id=asked.map_id,
        only_maps=maps_of_key(request),
        after=asked.after(),
        limit=asked.limit,
    )
    links = list_links(request, asked, page, lambda job: (job.created, job.job_id))
    waits = _waits(services, page.items)
    return JobList(
        jobs=[job_document(job, request, waits.get(job.job_id)) for job in page.items], links=links
    )


@router.get("/jobs/{job_id}", summary="Follow a job", responses=_LOOKED_AT | NAMED)
async def get_job(
    request: Request,
    response: Response,
    services: Provided,
    job_id: JobId,
    asked: Annotated[JobRequest, Query()],
) -> JobDocument:
    """Its state, stage and progress; a failed job carries its problem.

    To wait for a job ask again with `wait=20` until its `status` is `successful`, `failed` or `dismissed`: the answer
    comes as soon as it has ended. A client that waits for many jobs follows `GET /events?type=job.ended` instead: first
    take a `cursor` there, then look at each job once, then go on from the cursor.

    A job goes with the map or survey that it made: once that is deleted it is a 404, though `job.ended` is told.
    """
    job = await _awaited(services, job_id, asked.wait)
    waits = await run_in_threadpool(_waits, services, [job])
    if job.status in OPEN:
        response.headers["Retry-After"] = str(LOOK_AGAIN_S)
    return job_document(job, request, waits.get(job_id))


async def _awaited(services: Services, job_id: str, wait_s: float) -> JobRecord:
    """Return a job; one that has not ended once it has, or after so long. Raises NotFound and Unavailable."""
    until = time.monotonic() + wait_s
    listeners = services.listeners

    async def look() -> JobRecord:
        return await run_in_threadpool(services.catalog.jobs.get, job_id)

    job = await look()
    if wait_s == 0 or job.status not in OPEN:
        return job
    listeners.require_room()
    ended: tuple[EventType, ...] = ("job.ended",)
    wanted = EventFilter(types=ended, maps=(job.map_id,))
    with listeners.joined():
        cursor = await listeners.last()
        job = await look()  # it may have ended before the cursor
        while job.status in OPEN and (left := until - time.monotonic()) > 0 and not listeners.ended:
            page = await listeners.next(cursor, wanted, limit=_EVENTS, wait_s=left)
            cursor, job = page.cursor, await look()
    return job


@router.delete(
    "/jobs/{job_id}",
    summary="Dismiss a job",
    responses=documented("not_found", "conflict", "invalid_request"),
)
async def dismiss_job(request: Request, services: Provided, job_id: JobId) -> JobDocument:
    """Stops the work for good, and answers the same when asked again.

    The standard (requirements class Dismiss) wants a 200 to say `dismissed`; a job that had ended by itself
    keeps its state, so it answers 409.
    """
    return job_document(await services.writes.run(dismiss, services, job_id), request)


@router.post(
    "/jobs/{job_id}/retry",
    status_code=202,
    summary="Run a failed job again",
    responses=SUBMITTED
    | documented(
        "not_found", "conflict", "invalid_request", "disk_full", "queue_unavailable", "queue_full", *KEYED
    ),
)
async def retry_job(
    request: Request, response: Response, services: Provided, job_id: JobId, keyed: Keyed
) -> JobDocument:
    """Goes on with the step that it failed in, once what was wrong is mended: a full disk, a setting, a worker.

    A job that waits or runs is left as it is, so that a retry may be sent twice; under an Idempotency-Key also once the
    job has failed again.
    """

    def accept(job: JobRecord) -> Answer:
        return accepted(request, job_document(job, request), job)

    job = await services.writes.run(run_again, services, job_id, keyed.once(None, accept))
    response.headers.update(job_headers(request, job))
    return job_document(job, request)


Wait = tuple[int, float]  #: position in its queue, seconds waited


def _waits(services: Services, jobs: Sequence[JobRecord]) -> dict[str, Wait]:
    """Return where the steps stand that wait; nothing is asked where all of `jobs` have ended."""
    if not any(job.status in OPEN for job in jobs):
        return {}
    instant, open_jobs = now(), services.catalog.jobs.open_jobs()
    positions = queue_positions(open_jobs, instant)
    since = {job.job_id: max(0.0, (instant - job.due).total_seconds()) for job in open_jobs}
    return {job_id: (position, round(since[job_id], 3)) for job_id, position in positions.items()}


def job_document(record: JobRecord, request: Request, wait: Wait | None = None) -> JobDocument:
    """Return a job with its links: itself, and its result once there is one; `wait` of one whose step waits."""
    links = [link(request, f"/jobs/{record.job_id}", "self")]
    if record.status == "successful":
        links += [
            link(request, _result(record), "related"),
            link(request, f"/jobs/{record.job_id}/results", RESULTS),
        ]
    position, waited_s = wait or (None, None)
    return JobDocument(links=links, queue_position=position, waiting_s=waited_s, **dict(record))


def _result(record: JobRecord) -> str:
    if record.model is not None:
        return model_path(record.model)
    return f"/maps/{record.map_id}" if record.survey_id is None else f"/surveys/{record.survey_id}"
