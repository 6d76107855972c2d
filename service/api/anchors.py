"""/maps/{id}/anchor: where a map lies on the Earth, for features in WGS 84."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.concurrency import run_in_threadpool

from service.api import bodies
from service.api.map_documents import MapDocument, map_document
from service.api.problems import documented
from service.api.requests import AnchorRequest, checked
from service.api.schema import body_of
from service.api.services import Provided
from service.api.values import Id

router = APIRouter(tags=["maps"])
MapId = Annotated[Id, Path()]


@router.put(
    "/maps/{map_id}/anchor",
    summary="Say where a map lies on the Earth",
    responses=documented(
        "incomplete_body", "not_found", "too_large", "wrong_media_type", "bad_request", "invalid_request"
    ),
    openapi_extra=body_of(json=AnchorRequest),
)
async def put_anchor(request: Request, services: Provided, map_id: MapId) -> MapDocument:
    """From now on every feature of the map, old or new, carries its footprint in WGS 84 as `geometry`."""
    async with bodies.received(request, services.settings, takes=(bodies.JSON,), files="") as body:
        wanted = checked(AnchorRequest, body.fields)
    found = await run_in_threadpool(services.catalog.maps.set_anchor, map_id, wanted.anchor())
    return map_document(found, request)


@router.delete(
    "/maps/{map_id}/anchor",
    status_code=204,
    summary="Take a map off the Earth",
    responses=documented("not_found", "invalid_request"),
)
def delete_anchor(services: Provided, map_id: MapId) -> None:
    """Features have no `geometry` then; once more changes nothing."""
    services.catalog.maps.set_anchor(map_id, None)
