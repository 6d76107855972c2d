"""/ and /conformance: where a client begins that knows nothing but the address (OGC 18-062r2, Sections 7.2 to 7.4)."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from pydantic import Field

from service.api.http.answering.documents import Document, Link, link
from service.api.http.dependencies import Provided
from service.tile_features import CONFORMS_TO
from service.web.pages import viewer_page, wants_page

RELATIONS = "http://www.opengis.net/def/rel/ogc/1.0"  #: of links, as OGC names them
_OPENAPI = "application/vnd.oai.openapi+json;version=3.1"

router = APIRouter(tags=["service"])


class LandingPage(Document):
    """What the service is, and where all that it has begins."""

    title: str = Field(examples=["SPICD"])
    description: str = Field(examples=["LiDAR scans in, changed tiles and a coloured cloud out"])
    links: list[Link]


class Conformance(Document):
    """The standards that the answers keep to, each by the name of its conformance class."""

    conformsTo: tuple[str, ...] = Field(examples=[CONFORMS_TO])  # noqa: N815 - the standard's name


@router.get(
    "/",
    summary="Where everything begins",
    response_model=LandingPage,
    responses={200: {"content": {"text/html": {"schema": {"type": "string"}}}}},
)
async def get_landing_page(
    request: Request, response: Response, services: Provided
) -> LandingPage | Response:
    """Links to the lists, to the description of the API and to the processes; for browsers the viewer."""
    if wants_page(request):
        return await viewer_page(request, frames=services.settings.origins())
    response.headers["Vary"] = "Accept"
    return LandingPage(
        title=request.app.title,
        description=request.app.summary,
        links=[
            link(request, "/", "self"),
            link(request, "/openapi.json", "service-desc", _OPENAPI),
            link(request, "/docs", "service-doc", "text/html"),
            link(request, "/conformance", f"{RELATIONS}/conformance"),
            link(request, "/processes", f"{RELATIONS}/processes"),
            link(request, "/jobs", f"{RELATIONS}/job-list"),
            link(request, "/maps", "maps"),
            link(request, "/scans", "scans"),
            link(request, "/models", "models"),
            link(request, "/health/ready", "status"),
        ],
    )


@router.get("/conformance", summary="Which standards the answers keep to")
async def get_conformance() -> Conformance:
    """Those of features. Of OGC API - Processes none is named, for its core asks a service to fetch inputs from addresses."""
    return Conformance(conformsTo=CONFORMS_TO)
