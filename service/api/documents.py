"""What clients get, as documents; maps are in map_documents.py, features in features.py and problems in problems.py."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from fastapi import Request
from pydantic import BaseModel, ConfigDict, Field

from service.api.problems import ProblemDocument, problem_of
from service.catalog.records import (
    JobRecord,
    JobStatus,
    Matrix,
    Problem,
    ScanFormat,
    ScanOutcome,
    ScanRecord,
    SurveyRecord,
    SurveyStatus,
)

RESULTS = "http://www.opengis.net/def/rel/ogc/1.0/results"  #: OGC 18-062r2, Section 7.11


class Document(BaseModel):
    """Base of every document."""

    model_config = ConfigDict(frozen=True)


class Link(Document):
    """Where to go on (RFC 8288); `href` is a path on this host."""

    href: str = Field(examples=["/jobs/job-5f0c"])
    rel: str = Field(examples=["self"])
    type: str = "application/json"


class ScanDocument(Document):
    """One uploaded scan."""

    scan_id: str = Field(examples=["scan-2b1f"])
    filename: str = Field(examples=["hall.pcd"])
    format: ScanFormat
    size: int = Field(description="bytes", examples=[1296000])
    sha256: str
    device_id: str | None
    captured_at: datetime | None
    pose: Matrix | None = Field(description="map_from_sensor as it was given, row-major")
    created: datetime


class SurveyDocument(Document):
    """A survey and what became of its scans."""

    survey_id: str = Field(examples=["survey-91c4"])
    map_id: str = Field(examples=["lobby"])
    map_version: int = Field(description="of the map, that the survey is compared with", examples=[1])
    status: SurveyStatus
    model: str = Field(examples=["spicd-net/1"])
    threshold: float | None = Field(description="asked for, then the one that was used")
    device_id: str | None
    captured_at: datetime
    scans: tuple[ScanOutcome, ...]
    counts: dict[str, int] = Field(
        examples=[{"tiles": 172, "unchanged": 150, "changed": 9, "inconsistent": 1, "unobserved": 12}]
    )
    job_id: str
    problem: ProblemDocument | None
    created: datetime
    updated: datetime
    links: list[Link]


class JobDocument(Document):
    """The status of a job (OGC API - Processes - Part 1, statusInfo), with what it works on."""

    jobID: str = Field(examples=["job-5f0c"])  # noqa: N815 - the standard's name
    processID: Literal["map", "survey", "model"]  # noqa: N815 - the standard's name
    type: Literal["process"] = "process"
    status: JobStatus
    message: str = Field(description="the stage", examples=["registering"])
    progress: int = Field(ge=0, le=100, examples=[40])
    created: datetime
    started: datetime | None
    finished: datetime | None
    updated: datetime
    map_id: str
    survey_id: str | None
    model: str | None = Field(description="that a training makes", examples=[None])
    problem: ProblemDocument | None
    links: list[Link]


class AcceptedSurvey(Document):
    """A survey that is going to be compared."""

    survey_id: str = Field(examples=["survey-91c4"])
    map_id: str = Field(examples=["lobby"])
    job_id: str = Field(examples=["job-5f0c"])
    status: SurveyStatus
    links: list[Link]


def scan_document(record: ScanRecord) -> ScanDocument:
    """A scan, less where its blob lies."""
    return ScanDocument(**record.model_dump(exclude={"key"}))


def survey_document(record: SurveyRecord, request: Request) -> SurveyDocument:
    """A survey with its links."""
    here = f"/surveys/{record.survey_id}"
    links = [
        link(request, here, "self"),
        link(request, f"/jobs/{record.job_id}", "monitor"),
        link(request, f"/maps/{record.map_id}", "map"),
    ]
    if record.status == "ready":
        links += [
            link(request, f"{here}/tiles", "tiles", "application/geo+json"),
            link(request, f"{here}/cloud.ply", "cloud", "application/octet-stream"),
            link(request, f"{here}/picture.png", "preview", "image/png"),
        ]
    return SurveyDocument(
        **record.model_dump(exclude={"problem"}), problem=problem_document(record.problem), links=links
    )


def job_document(record: JobRecord, request: Request) -> JobDocument:
    """A job with its links: itself, and its result once there is one."""
    links = [link(request, f"/jobs/{record.job_id}", "self")]
    if record.status == "successful":
        links.append(link(request, _result(record), RESULTS))
    return JobDocument(
        jobID=record.job_id,
        processID=record.kind,
        problem=problem_document(record.problem),
        links=links,
        **record.model_dump(exclude={"job_id", "kind", "problem"}),
    )


def model_path(model: str) -> str:
    """Where the card of `name/version` is."""
    name, version = model.split("/")
    return f"/models/{name}?version={version}"


def _result(record: JobRecord) -> str:
    if record.model is not None:
        return model_path(record.model)
    return f"/maps/{record.map_id}" if record.survey_id is None else f"/surveys/{record.survey_id}"


def link(request: Request, path: str, rel: str, media_type: str = "application/json") -> Link:
    """A link to a path of this API, wherever it is mounted."""
    return Link(href=request.scope.get("root_path", "") + path, rel=rel, type=media_type)


def problem_document(problem: Problem | None) -> ProblemDocument | None:
    """The problem of a job that failed."""
    return None if problem is None else problem_of(problem)
