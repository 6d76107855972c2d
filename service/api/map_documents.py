"""Maps and their versions, as documents."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from fastapi import Request
from pydantic import Field

from service.api.documents import Document, Link, link, problem_document
from service.api.problems import ProblemDocument
from service.catalog.records import Anchor, Bounds, MapRecord, MapStatus, ScanOutcome, VersionRecord

_RAW, _GEOJSON = "application/octet-stream", "application/geo+json"


class _Built(Document):
    """What a map and a version of it have in common."""

    map_id: str = Field(examples=["lobby"])
    version: int = Field(examples=[1])
    status: MapStatus
    model: str = Field(examples=["spicd-net/1"])
    settings: dict[str, Any]
    scans: tuple[ScanOutcome, ...]
    bounds: Bounds | None = Field(description="metres, map frame")
    counts: dict[str, int] = Field(examples=[{"points": 181342, "tiles": 172, "scans": 25, "accepted": 24}])
    registration: dict[str, Any] | None = Field(
        description="totals of the registration of what is new in it (paper, Table 2); null until it is built",
        examples=[
            {"scans": 25, "accepted": 24, "pairs_possible": 300, "pairs_tried": 61, "pairs_accepted": 58}
        ],
    )
    job_id: str
    problem: ProblemDocument | None
    created: datetime
    updated: datetime
    links: list[Link]


class MapDocument(_Built):
    """A reference map as its version in use: the newest that is ready, and the newest where none is."""

    name: str | None
    anchor: Anchor | None = Field(description="where the map lies on the Earth; null: nobody said")


class VersionDocument(_Built):
    """One state of a map, and what it was made from."""

    base_version: int | None = Field(description="the version it goes on from; null in the first")
    survey_id: str | None = Field(description="the survey it takes over; null where it is made of scans")


class AcceptedMap(Document):
    """A map that is going to be built."""

    map_id: str = Field(examples=["lobby"])
    job_id: str = Field(examples=["job-5f0c"])
    status: MapStatus
    links: list[Link]


class AcceptedVersion(Document):
    """A version of a map that is going to be built; the one in use stays in use until then."""

    map_id: str = Field(examples=["lobby"])
    version: int = Field(examples=[2])
    job_id: str = Field(examples=["job-5f0c"])
    status: MapStatus
    links: list[Link]


def map_document(record: MapRecord, request: Request) -> MapDocument:
    """A map with its links."""
    here = f"/maps/{record.map_id}"
    links = [
        link(request, here, "self"),
        link(request, f"/jobs/{record.job_id}", "monitor"),
        link(request, f"{here}/versions", "version-history"),
    ]
    if record.status == "ready":
        links += [*_files(request, here), link(request, f"{here}/changes", "changes", _GEOJSON)]
    return MapDocument(**_facts(record), links=links)


def version_document(record: VersionRecord, request: Request) -> VersionDocument:
    """A version of a map with its links."""
    here = f"/maps/{record.map_id}/versions/{record.version}"
    links = [
        link(request, here, "self"),
        link(request, f"/jobs/{record.job_id}", "monitor"),
        link(request, f"/maps/{record.map_id}", "map"),
    ]
    if record.survey_id is not None:
        links.append(link(request, f"/surveys/{record.survey_id}", "survey"))
    if record.status == "ready":
        links += _files(request, here)
    return VersionDocument(**_facts(record), links=links)


def _files(request: Request, here: str) -> list[Link]:
    return [
        link(request, f"{here}/manifest", "manifest"),
        link(request, f"{here}/cloud.ply", "cloud", _RAW),
    ]


def _facts(record: MapRecord | VersionRecord) -> dict[str, Any]:
    return {**record.model_dump(exclude={"problem"}), "problem": problem_document(record.problem)}
