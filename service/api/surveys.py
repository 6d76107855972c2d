"""/maps/{id}/surveys and /surveys: later visits, compared with a map by a job."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api import bodies, features, files, site_models
from service.api.bodies import Body
from service.api.documents import AcceptedSurvey, Document, Link, SurveyDocument, link, survey_document
from service.api.features import FeatureResponse, feature_response
from service.api.files import blob_response
from service.api.paging import PageRequest, list_links
from service.api.problems import documented
from service.api.requests import SurveyRequest, checked
from service.api.schema import body_of
from service.api.services import Provided, Services
from service.api.submission import kept_scans, stop_if_open, submit
from service.api.values import Id
from service.catalog import blob_keys
from service.catalog.records import JobRecord, MapRecord, SurveyRecord

router = APIRouter(tags=["surveys"])
MapId = Annotated[Id, Path()]
SurveyId = Annotated[Id, Path()]


class SurveyList(Document):
    """Surveys, newest first."""

    surveys: list[SurveyDocument]
    links: list[Link]


@router.post(
    "/maps/{map_id}/surveys",
    status_code=202,
    summary="Compare a visit with a map",
    responses=documented(
        "incomplete_body",
        "not_found",
        "not_ready",
        "too_large",
        "wrong_media_type",
        "bad_request",
        "invalid_request",
        "scan_unreadable",
        "queue_unavailable",
    ),
    openapi_extra=body_of(json=SurveyRequest, form=SurveyRequest, file="scans"),
)
async def create_survey(
    request: Request, response: Response, services: Provided, map_id: MapId
) -> AcceptedSurvey:
    """Of scans uploaded before (`scan_ids`) or sent here (`scans`), with the version of the map that is in use now."""
    reference = await run_in_threadpool(services.catalog.maps.ready, map_id)  # before a long upload
    async with bodies.received(
        request, services.settings, takes=(bodies.JSON, bodies.FORM), files="scans"
    ) as body:
        wanted = checked(SurveyRequest, body.fields)
        record, job = await run_in_threadpool(_create, services, reference, wanted, body)
    monitor = link(request, f"/jobs/{job.job_id}", "monitor")
    response.headers["Location"] = monitor.href
    return AcceptedSurvey(
        survey_id=record.survey_id,
        map_id=map_id,
        job_id=job.job_id,
        status=record.status,
        links=[link(request, f"/surveys/{record.survey_id}", "self"), monitor],
    )


@router.get(
    "/maps/{map_id}/surveys",
    summary="List surveys",
    responses=documented("not_found", "invalid_request", "bad_request"),
)
def list_surveys(
    request: Request, services: Provided, map_id: MapId, asked: Annotated[PageRequest, Query()]
) -> SurveyList:
    """Of one map, newest first."""
    services.catalog.maps.get(map_id)
    page = services.catalog.surveys.page(map_id, after=asked.after(), limit=asked.limit)
    links = list_links(request, page, lambda found: (found.created, found.survey_id))
    return SurveyList(surveys=[survey_document(found, request) for found in page.items], links=links)


@router.get(
    "/surveys/{survey_id}", summary="Look at a survey", responses=documented("not_found", "invalid_request")
)
def get_survey(request: Request, services: Provided, survey_id: SurveyId) -> SurveyDocument:
    """Its state, what became of each scan, and the tiles in each state once it is ready."""
    return survey_document(services.catalog.surveys.get(survey_id), request)


@router.delete(
    "/surveys/{survey_id}",
    status_code=204,
    summary="Delete a survey",
    responses=documented("not_found", "conflict", "invalid_request"),
)
def delete_survey(services: Provided, survey_id: SurveyId) -> None:
    """With its job and files; a job that still runs is stopped first. Its scans stay.

    Versions of the map that took the survey over stay as well; while one is being built of it, this is a conflict.
    """
    stop_if_open(services, services.catalog.surveys.get(survey_id).job_id)
    services.catalog.surveys.delete(survey_id)


@router.get(
    "/surveys/{survey_id}/tiles",
    summary="Every tile of a survey",
    response_class=FeatureResponse,
    response_model=None,
    responses={**features.documented(), **documented("not_found", "not_ready", "invalid_request")},
)
def get_tiles(request: Request, services: Provided, survey_id: SurveyId) -> FeatureResponse:
    """Unchanged, changed, inconsistent and unobserved tiles alike."""
    survey = services.catalog.surveys.ready(survey_id)
    anchor = services.catalog.maps.get(survey.map_id).anchor
    tiles = services.catalog.changes.of_survey(survey_id)
    here = link(request, f"/surveys/{survey_id}/tiles", "self", features.MEDIA_TYPE)
    return feature_response(tiles, matched=len(tiles), links=[here], anchor=anchor)


@router.get(
    "/surveys/{survey_id}/cloud.ply",
    summary="The coloured cloud of a survey",
    response_class=Response,
    responses={
        **files.documented(bodies.RAW, "The current map coloured by result, PLY"),
        **documented("not_found", "not_ready", "invalid_request"),
    },
)
def get_survey_cloud(services: Provided, survey_id: SurveyId) -> Response:
    """With the scalar fields `change_score` and `tile_state` beside the colours."""
    services.catalog.surveys.ready(survey_id)
    return blob_response(
        services.catalog.blobs,
        blob_keys.survey_cloud(survey_id),
        media_type=bodies.RAW,
        filename=f"{survey_id}.ply",
    )


@router.get(
    "/surveys/{survey_id}/picture.png",
    summary="The picture of a survey",
    response_class=Response,
    responses={
        **files.documented("image/png", "Top view of the map, tiles by state"),
        **documented("not_found", "not_ready", "invalid_request"),
    },
)
def get_picture(services: Provided, survey_id: SurveyId) -> Response:
    """Top view of the map with the tiles by state."""
    services.catalog.surveys.ready(survey_id)
    return blob_response(services.catalog.blobs, blob_keys.survey_picture(survey_id), media_type="image/png")


def _create(
    services: Services, reference: MapRecord, wanted: SurveyRequest, body: Body
) -> tuple[SurveyRecord, JobRecord]:
    catalog = services.catalog
    model = site_models.check(services, wanted.model or reference.model)
    with kept_scans(
        catalog,
        body.uploads,
        wanted.scan_ids,
        device_id=wanted.device_id,
        captured_at=wanted.captured_at,
    ) as scan_ids:
        record, job = catalog.surveys.create(
            reference.map_id,
            scan_ids=scan_ids,
            model=model,
            threshold=wanted.threshold,
            device_id=wanted.device_id,
            captured_at=wanted.captured_at,
        )
        submit(services, job, forget=lambda: catalog.surveys.delete(record.survey_id))
    return record, job
