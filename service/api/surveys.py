"""/maps/{id}/surveys and /surveys: later visits, compared with a map by a job."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from fastapi import Request as HttpRequest
from fastapi.concurrency import run_in_threadpool
from pydantic import Field

from service.api.gis import features
from service.api.http.answering import files
from service.api.http.answering.documents import Document, Link, checked, link
from service.api.http.answering.files import blob_response
from service.api.http.answering.paging import PageRequest, list_links
from service.api.http.answering.problems import BODY, MADE, NAMED, JobProblem, documented
from service.api.http.dependencies import Provided, Services
from service.api.http.guards.access import maps_of_key
from service.api.http.reading import bodies
from service.api.http.reading.bodies import Body
from service.api.http.reading.fields import DeviceId, Id, Instant, Model
from service.api.http.reading.idempotency import KEYED, Keyed
from service.api.http.reading.submission import (
    SUBMITTED,
    ScansRequest,
    accepted,
    admit,
    delete,
    job_headers,
    kept_scans,
    lane,
    monitor,
    stop_if_open,
    submit,
)
from service.catalog.files import blob_keys
from service.catalog.idempotency import Answer, Once
from service.catalog.records import JobRecord, MapSummary, SurveyRecord, SurveyStatus, SurveySummary

router = APIRouter(tags=["surveys"])
MapId = Annotated[Id, Path()]
SurveyId = Annotated[Id, Path()]


class SurveyRequest(ScansRequest):
    """A visit to compare with a map, of scans that were uploaded before, or come with the request."""

    captured_at: Annotated[Instant | None, Field(description="left out: the latest of its scans")] = None
    device_id: DeviceId | None = None
    model: Annotated[Model | None, Field(description="left out: the model of the map")] = None
    threshold: Annotated[
        float | None, Field(ge=0, le=1, description="probability of change; left out: the model's own")
    ] = None


class SurveyDocument(SurveyRecord, Document):
    """A survey and what became of its scans."""

    problem: JobProblem  # type: ignore[assignment]  # as RFC 9457 has it
    links: list[Link]


class SurveySummaryDocument(SurveySummary, Document):
    """A survey in short; the survey itself tells what became of each scan."""

    problem: JobProblem  # type: ignore[assignment]  # as RFC 9457 has it
    links: list[Link]


class AcceptedSurvey(Document):
    """A survey that is going to be compared."""

    survey_id: str = Field(examples=["survey-91c4"])
    map_id: str = Field(examples=["lobby"])
    job_id: str = Field(examples=["job-5f0c"])
    status: SurveyStatus
    links: list[Link]


class SurveyList(Document):
    """Surveys, newest first."""

    surveys: list[SurveySummaryDocument]
    links: list[Link]


@router.post(
    "/maps/{map_id}/surveys",
    status_code=202,
    summary="Compare a visit with a map",
    responses=SUBMITTED
    | documented(
        *BODY,
        "not_found",
        "not_ready",
        "failed",
        "scan_unreadable",
        "queue_unavailable",
        "queue_full",
        *KEYED,
    ),
    openapi_extra=bodies.documented(json=SurveyRequest, form=SurveyRequest, file="scans"),
)
async def create_survey(
    request: HttpRequest, response: Response, services: Provided, map_id: MapId, keyed: Keyed
) -> AcceptedSurvey:
    """Of scans uploaded before (`scan_ids`, or `scans` with poses for this survey) or sent here, as files of a form.

    They are compared with the version of the map that is in use now.
    """

    def accept(record: SurveyRecord, job: JobRecord) -> Answer:
        return accepted(request, _accepted(request, record, job), job)

    reference = await run_in_threadpool(services.catalog.maps.ready, map_id)  # before a long upload
    if not keyed.seen:
        await run_in_threadpool(admit, services)
    async with bodies.received(request, services) as body:
        wanted, once = checked(SurveyRequest, body.fields), keyed.once(body, accept)
        record, job = await lane(services, body).run(
            _create, services, reference, wanted, body, maps_of_key(request), request.state.key, once
        )
    response.headers.update(job_headers(request, job))
    return _accepted(request, record, job)


@router.get(
    "/maps/{map_id}/surveys",
    summary="List surveys",
    responses=documented("not_found", "invalid_request", "bad_request"),
)
def list_surveys(
    request: HttpRequest, services: Provided, map_id: MapId, asked: Annotated[PageRequest, Query()]
) -> SurveyList:
    """Of one map in short, newest first."""
    services.catalog.maps.summary(map_id)
    page = services.catalog.surveys.page(map_id, after=asked.after(), limit=asked.limit)
    links = list_links(request, asked, page, lambda record: (record.created, record.survey_id))
    surveys = [SurveySummaryDocument(**dict(one), links=_links(one, request)) for one in page.items]
    return SurveyList(surveys=surveys, links=links)


@router.get("/surveys/{survey_id}", summary="Look at a survey", responses=NAMED)
def get_survey(request: HttpRequest, services: Provided, survey_id: SurveyId) -> SurveyDocument:
    """Its state, what became of each scan, how sure their placement is, and once it is ready tiles and objects counted."""
    return survey_document(services.catalog.surveys.get(survey_id), request)


@router.delete(
    "/surveys/{survey_id}",
    status_code=204,
    summary="Delete a survey",
    responses=documented("not_found", "conflict", "invalid_request"),
)
async def delete_survey(services: Provided, survey_id: SurveyId) -> None:
    """With its job and files; a job that still runs is stopped first. Its scans stay.

    Its job is a 404 from then on; of one that was stopped `job.ended` is told nevertheless, with the status `dismissed`.

    Versions of the map that took the survey over stay as well; while one is being built of it, this is a conflict.
    """
    await delete(services, _delete, services, survey_id)


@router.get(
    "/surveys/{survey_id}/cloud.ply",
    summary="The coloured cloud of a survey",
    response_class=Response,
    responses=files.documented(bodies.RAW, "The current map coloured by result, PLY") | MADE,
)
async def get_survey_cloud(services: Provided, survey_id: SurveyId) -> Response:
    """With the scalar fields `scalar_change_score` and `scalar_tile_state` beside the colours; its header has the legend."""
    await run_in_threadpool(services.catalog.surveys.ready, survey_id)
    return await blob_response(
        services.catalog.blobs,
        blob_keys.survey_cloud(survey_id),
        media_type=bodies.RAW,
        filename=f"{survey_id}.ply",
        immutable=True,
    )


@router.get(
    "/surveys/{survey_id}/cloud.laz",
    summary="The coloured cloud of a survey, packed",
    response_class=Response,
    responses=files.documented(bodies.LAZ, "The current map coloured by result, LAZ 1.4") | MADE,
)
async def get_survey_laz(services: Provided, survey_id: SurveyId) -> Response:
    """The points of `cloud.ply` to the millimetre, for desktops: `change_score`, `tile_state`, `kind` and `object_id` as extra bytes.

    A survey of release 0.1 has none.
    """
    await run_in_threadpool(services.catalog.surveys.ready, survey_id)
    return await blob_response(
        services.catalog.blobs,
        blob_keys.survey_laz(survey_id),
        media_type=bodies.LAZ,
        filename=f"{survey_id}.laz",
        immutable=True,
    )


@router.get(
    "/surveys/{survey_id}/picture.png",
    summary="The picture of a survey",
    response_class=Response,
    responses=files.documented("image/png", "Top view of the map, tiles by state") | MADE,
)
async def get_picture(services: Provided, survey_id: SurveyId) -> Response:
    """Top view of the map with objects and tiles by state; where every scan was refused, the map and why."""
    refused = _refused(await run_in_threadpool(services.catalog.surveys.get, survey_id))
    if not refused:
        await run_in_threadpool(services.catalog.surveys.ready, survey_id)
    key = blob_keys.survey_picture(survey_id)
    # a survey that was refused may run again, one that is ready does not
    return await blob_response(services.catalog.blobs, key, media_type="image/png", immutable=not refused)


def _refused(survey: SurveySummary) -> bool:
    """Whether a survey failed because no scan of it was accepted, which has a picture."""
    placement = survey.placement
    return survey.status == "failed" and placement is not None and placement.state == "refused"


def _accepted(request: HttpRequest, record: SurveyRecord, job: JobRecord) -> AcceptedSurvey:
    return AcceptedSurvey(
        survey_id=record.survey_id,
        map_id=record.map_id,
        job_id=job.job_id,
        status=record.status,
        links=[link(request, f"/surveys/{record.survey_id}", "self"), monitor(request, job)],
    )


def _create(
    services: Services,
    reference: MapSummary,
    wanted: SurveyRequest,
    body: Body,
    maps: Collection[str] | None,
    key: str | None,
    once: Once,
) -> tuple[SurveyRecord, JobRecord]:
    """Record and submit; who takes turns with others is the device, where none is named the key, else the map."""
    once.look()
    owner = wanted.device_id or key or reference.map_id
    admit(services, owner)
    catalog = services.catalog
    model = services.cards.check(wanted.model or reference.model, maps)
    with kept_scans(catalog, body, wanted) as scan_ids:
        record, job = catalog.surveys.create(
            reference.map_id,
            scan_ids=scan_ids,
            poses=wanted.poses,
            model=model,
            threshold=wanted.threshold,
            device_id=wanted.device_id,
            captured_at=wanted.captured_at,
            owner=owner,
            once=once,
        )
        submit(services, job, forget=lambda: catalog.surveys.delete(record.survey_id), once=once)
    return record, job


def _delete(services: Services, survey_id: str) -> None:
    stop_if_open(services, services.catalog.surveys.get(survey_id).job_id)
    services.catalog.surveys.delete(survey_id)


def survey_document(record: SurveyRecord, request: HttpRequest) -> SurveyDocument:
    """Return a survey with its links."""
    return SurveyDocument(**dict(record), links=_links(record, request))


def _links(record: SurveySummary, request: HttpRequest) -> list[Link]:
    here = f"/surveys/{record.survey_id}"
    links = [
        link(request, here, "self"),
        link(request, f"/jobs/{record.job_id}", "monitor"),
        link(request, f"/maps/{record.map_id}", "map"),
    ]
    if record.status == "ready":
        links += [
            link(request, f"{here}/tiles", "tiles", features.MEDIA_TYPE),
            link(request, f"{here}/cloud.ply", "cloud", bodies.RAW),
            link(request, f"{here}/cloud.laz", "cloud-laz", bodies.LAZ),
            link(request, f"{here}/picture.png", "preview", "image/png"),
        ]
    if record.tileset is not None:
        links.append(link(request, f"{here}/tileset.json", "tileset"))
    if _refused(record):
        links.append(link(request, f"{here}/picture.png", "preview", "image/png"))
    if record.status == "ready" and record.objects is not None:
        links.append(link(request, f"{here}/objects", "objects", features.MEDIA_TYPE))
    return links
