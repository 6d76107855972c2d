"""/jobs: the status of every job (OGC API - Processes - Part 1: Core, OGC 18-062r2)."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request

from service.api.documents import Document, JobDocument, Link, job_document
from service.api.paging import PageRequest, list_links
from service.api.problems import documented
from service.api.services import Provided
from service.api.submission import dismiss
from service.api.values import Id
from service.catalog.records import JobStatus

router = APIRouter(tags=["jobs"])
JobId = Annotated[Id, Path()]


class JobsRequest(PageRequest):
    """Which jobs."""

    status: JobStatus | None = None
    map_id: Id | None = None


class JobList(Document):
    """Jobs, newest first."""

    jobs: list[JobDocument]
    links: list[Link]


@router.get("/jobs", summary="List jobs", responses=documented("invalid_request", "bad_request"))
def list_jobs(request: Request, services: Provided, asked: Annotated[JobsRequest, Query()]) -> JobList:
    """Newest first."""
    page = services.catalog.jobs.page(
        status=asked.status, map_id=asked.map_id, after=asked.after(), limit=asked.limit
    )
    links = list_links(request, page, lambda job: (job.created, job.job_id))
    return JobList(jobs=[job_document(job, request) for job in page.items], links=links)


@router.get("/jobs/{job_id}", summary="Follow a job", responses=documented("not_found", "invalid_request"))
def get_job(request: Request, services: Provided, job_id: JobId) -> JobDocument:
    """Its state, stage and progress; a failed job carries its problem."""
    return job_document(services.catalog.jobs.get(job_id), request)


@router.delete(
    "/jobs/{job_id}",
    summary="Dismiss a job",
    responses=documented("not_found", "conflict", "invalid_request"),
)
def dismiss_job(request: Request, services: Provided, job_id: JobId) -> JobDocument:
    """Stops the work for good, and answers the same when asked again.

    The standard (requirements class Dismiss) wants a 200 to say `dismissed`; a job that had ended by itself
    keeps its state, so it answers 409.
    """
    return job_document(dismiss(services, job_id), request)
