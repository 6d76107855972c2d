"""/processes and /jobs/{id}/results: what jobs do, and what they made (OGC API - Processes - Part 1: Core 1.0).

The documents are those of the standard (OGC 18-062r2). A process is begun by the call that its description names, and not
by `/processes/{id}/execution`: the standard wants inputs taken by reference there (`/req/core/process-execute-inputs`), and
a service that fetches any address it is given is a way into its network.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field

from service.api.gis.features import MEDIA_TYPE
from service.api.http.answering import problems
from service.api.http.answering.documents import Document, Link, link
from service.api.http.answering.documents import Request as AskedFor
from service.api.http.answering.paging import here
from service.api.http.answering.problems import documented, job_failed
from service.api.http.dependencies import Provided, Services
from service.api.http.reading import bodies
from service.api.jobs import RESULTS, JobId
from service.api.maps import MapRequest
from service.api.models import TrainingRequest, model_path
from service.api.surveys import SurveyRequest
from service.catalog.records import JobRecord
from service.catalog.steps import JobKind
from service.errors import NoSuchJob, NoSuchProcess, NotFound, ResultNotReady

router = APIRouter(tags=["processes"])


@dataclass(frozen=True, kw_only=True, slots=True)
class Process:
    """What a kind of job does."""

    title: str
    description: str
    request: type[BaseModel]
    path: str  #: of the call that begins it
    outputs: Mapping[str, tuple[str, str]]  #: title and media type of each


_MAP_ID = {
    "title": "Map",
    "description": "The map that is ready, as in the path of the call",
    "minOccurs": 1,
    "maxOccurs": 1,
    "schema": {"type": "string", "pattern": "^[A-Za-z0-9_-]{1,64}$"},
}

PROCESSES: dict[JobKind, Process] = {
    "map": Process(
        title="Build a map",
        description="Registers scans to each other, fuses them into a reference map and cuts it into tiles.",
        request=MapRequest,
        path="/maps",
        outputs={
            "map": ("The version of the map, with what became of each scan", bodies.JSON),
            "manifest": ("Its tiles", bodies.JSON),
            "cloud": ("Its fused cloud, PLY", bodies.RAW),
        },
    ),
    "survey": Process(
        title="Compare a visit with a map",
        description="Registers the scans of a visit to a map and tells what changed, tile by tile and object by object.",
        request=SurveyRequest,
        path="/maps/{map_id}/surveys",
        outputs={
            "survey": ("The survey, with what became of each scan", bodies.JSON),
            "tiles": ("Every tile with its state and score", MEDIA_TYPE),
            "objects": (
                "What appeared, disappeared or moved; not of models that tell tiles alone",
                MEDIA_TYPE,
            ),
            "cloud": ("The cloud of the visit coloured by result, PLY", bodies.RAW),
            "picture": ("Top view of the map, tiles by state", "image/png"),
        },
    ),
    "model": Process(
        title="Train a model on a map",
        description="Trains a detector on the scans of a map, from nothing or further, without any label.",
        request=TrainingRequest,
        path="/maps/{map_id}/models",
        outputs={"model": ("The card of the model", bodies.JSON)},
    ),
}


class ProcessSummary(Document):
    """What a kind of job does (processSummary)."""

    id: str = Field(examples=["survey"])
    version: str = Field(description="that of the service", examples=["0.1.0"])
    title: str
    description: str
    jobControlOptions: tuple[Literal["async-execute", "dismiss"], ...] = (  # noqa: N815 - the standard's name
        "async-execute",
        "dismiss",
    )
    outputTransmission: tuple[Literal["reference"], ...] = ("reference",)  # noqa: N815 - the standard's name
    links: list[Link]


class ProcessDocument(ProcessSummary):
    """A kind of job with its inputs and outputs, each with a JSON Schema (process)."""

    inputs: dict[str, Any]
    outputs: dict[str, Any]


class ProcessList(Document):
    """All processes (processList)."""

    processes: list[ProcessSummary]
    links: list[Link]


class ProcessesRequest(AskedFor):
    """Which processes."""

    limit: Annotated[int, Field(ge=1, le=1000, description="most items in one answer")] = 100
    offset: Annotated[int, Field(ge=0, le=1000, description="from a `next` link")] = 0


class Results(Document):
    """What a job made, each output by a link (results)."""

    __pydantic_extra__: dict[str, Link]
    model_config = ConfigDict(extra="allow", frozen=True)


@router.get("/processes", summary="List processes", responses=documented("invalid_request"))
async def list_processes(request: Request, asked: Annotated[ProcessesRequest, Query()]) -> ProcessList:
    """The kinds of jobs."""
    kinds = list(PROCESSES)
    page = kinds[asked.offset : asked.offset + asked.limit]
    links = [Link(href=here(request), rel="self")]
    if (behind := asked.offset + asked.limit) < len(kinds):
        links.append(link(request, f"/processes?limit={asked.limit}&offset={behind}", "next"))
    return ProcessList(processes=[ProcessSummary(**_summary(request, kind)) for kind in page], links=links)


@router.get(
    "/processes/{process_id}",
    summary="Look at a process",
    responses=documented("no_such_process", "invalid_request"),
)
async def get_process(request: Request, process_id: Annotated[str, Path(max_length=64)]) -> ProcessDocument:
    """Its inputs, which are those of the call that begins it, and its outputs."""
    kind = next((kind for kind in PROCESSES if kind == process_id), None)
    if kind is None:
        raise NoSuchProcess(f"no process {process_id!r}; GET /processes lists those there are")
    return ProcessDocument(**_summary(request, kind), inputs=_inputs(kind), outputs=_outputs(kind))


@router.get(
    "/jobs/{job_id}/results",
    summary="What a job made",
    response_model=Results,
    responses={
        **documented("no_such_job", "result_not_ready", "invalid_request"),
        409: {
            "description": "The problem of a job that failed or was dismissed",
            "content": {problems.MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDocument"}}},
        },
    },
)
async def get_results(request: Request, services: Provided, job_id: JobId) -> Results | Response:
    """Every output by a link, once the job has ended well."""
    try:
        job = await run_in_threadpool(services.catalog.jobs.get, job_id)
    except NotFound as error:
        raise NoSuchJob(str(error)) from error
    if job.problem is not None:
        return job_failed(job.problem)
    if job.status != "successful":
        raise ResultNotReady(f"job {job_id!r} is {job.status}, at {job.progress}%; follow /jobs/{job_id}")
    paths = await run_in_threadpool(_paths, services, job)
    outputs = PROCESSES[job.kind].outputs
    return Results(**{name: link(request, path, RESULTS, outputs[name][1]) for name, path in paths.items()})


def _summary(request: Request, kind: JobKind) -> dict[str, Any]:
    process = PROCESSES[kind]
    return {
        "id": kind,
        "version": _version(),
        "title": process.title,
        "description": f"{process.description} `POST {process.path}` begins it.",
        "links": [link(request, f"/processes/{kind}", "self")],
    }


def _inputs(kind: JobKind) -> dict[str, Any]:
    """Return the inputs of a process: what its call reads, and the map of its path."""
    process = PROCESSES[kind]
    schema = process.request.model_json_schema()
    needed, definitions = schema.get("required", ()), schema.get("$defs", {})
    inputs = {"map_id": _MAP_ID} if "{map_id}" in process.path else {}
    for name, value in schema["properties"].items():
        own = _inlined(value, definitions)
        inputs[name] = {
            "title": own.pop("title", name),
            "description": own.pop("description", "see the call that begins it"),
            "minOccurs": int(name in needed),
            "maxOccurs": 1,
            "schema": own,
        }
    return inputs


def _outputs(kind: JobKind) -> dict[str, Any]:
    return {
        name: {"title": title, "schema": _of_media_type(media_type)}
        for name, (title, media_type) in PROCESSES[kind].outputs.items()
    }


def _of_media_type(media_type: str) -> dict[str, str]:
    """Return the schema of an output (OGC 18-062r2, Section 9.3): an object, or bytes of a media type."""
    if media_type.endswith("json"):
        return {"type": "object", "contentMediaType": media_type}
    return {"type": "string", "format": "binary", "contentMediaType": media_type}


def _inlined(value: Any, definitions: Mapping[str, Any]) -> Any:
    """Return a schema with what it refers to in its place: an input stands alone."""
    if isinstance(value, list):
        return [_inlined(entry, definitions) for entry in value]
    if not isinstance(value, dict):
        return value
    if isinstance(value.get("$ref"), str):
        rest = {name: entry for name, entry in value.items() if name != "$ref"}
        return _inlined({**definitions[value["$ref"].rpartition("/")[2]], **rest}, definitions)
    return {name: _inlined(entry, definitions) for name, entry in value.items()}


def _paths(services: Services, job: JobRecord) -> dict[str, str]:
    """Return where each output of a job lies that ended well. Raises NotFound where that was deleted."""
    if job.model is not None:
        return {"model": model_path(job.model)}
    if job.survey_id is None:
        number = services.catalog.versions.of_job(job.job_id).version
        built = f"/maps/{job.map_id}/versions/{number}"
        return {"map": built, "manifest": f"{built}/manifest", "cloud": f"{built}/cloud.ply"}
    survey = services.catalog.surveys.get(job.survey_id)
    told = f"/surveys/{job.survey_id}"
    paths = {
        "survey": told,
        "tiles": f"{told}/tiles",
        "cloud": f"{told}/cloud.ply",
        "picture": f"{told}/picture.png",
    }
    return paths if survey.objects is None else {**paths, "objects": f"{told}/objects"}


def _version() -> str:
    try:
        return version("spicd")
    except PackageNotFoundError:  # run from a checkout
        return "0"
