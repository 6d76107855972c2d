"""A program as its author types it, held by test_typing.py with `mypy --strict`; it is never run.

Where a line is wrong on purpose, the error that mypy has to find stands behind it: were it not found, the comment
itself would be the error.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, Literal, assert_type

from service.client import AsyncClient, ChangesPage, Client, Event, NewWebhook, RequestRefused, Retries
from service.client.documents import (
    AcceptedMap,
    JobDocument,
    MapDocument,
    MapSummaryDocument,
    ScanDocument,
    SurveyDocument,
    TileProperties,
)


def synchronous() -> None:
    with Client(retries=Retries(attempts=3)) as client:
        scan = client.upload_scan(Path("monday.pcd"))
        assert_type(scan, ScanDocument)
        building = client.create_map([scan["scan_id"]])
        assert_type(building, AcceptedMap)
        job = client.wait(building["job_id"])
        assert_type(job, JobDocument)
        assert_type(job["status"], Literal["accepted", "running", "successful", "failed", "dismissed"])
        assert_type(client.maps(), list[MapSummaryDocument])
        assert_type(client.survey("survey-1"), SurveyDocument)
        for feature in client.tiles("survey-1")["features"]:
            assert_type(feature["properties"], TileProperties)
            assert_type(feature["properties"]["score"], float | None)
        assert_type(client.follow_changes("lobby"), Iterator[ChangesPage])
        assert_type(client.create_webhook("https://here.example"), NewWebhook)
        client.survey("survey-1")["scan_id"]  # type: ignore[typeddict-item]
        client.survey("survey-1")["status"].sort()  # type: ignore[union-attr]
        client.create_map("scan-1", nmae="lobby")  # type: ignore[call-arg]


async def asynchronous() -> None:
    async with AsyncClient() as client:
        scan = await client.upload_scan(b"ply\n", filename="monday.ply")
        assert_type(scan, ScanDocument)
        assert_type(await client.map("lobby"), MapDocument)
        assert_type(client.events(types=["survey.ready"]), AsyncIterator[Event])
        async for event in client.events():
            assert_type(event["data"], dict[str, Any])
        client.map("lobby")["status"]  # type: ignore[index]


def refused(error: RequestRefused) -> tuple[int, float | None]:
    return error.status, error.retry_after_s
