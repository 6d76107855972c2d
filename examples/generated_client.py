"""The main job with a client that a generator made of the OpenAPI document: scans in, what changed out.

`docs/clients.md` says how `spicd_api` is made. Nothing of this repository is imported.
"""

from __future__ import annotations

import argparse
import os
import uuid
from pathlib import Path
from typing import TypeVar

from spicd_api import AuthenticatedClient
from spicd_api.api.changes import get_changes
from spicd_api.api.jobs import get_job
from spicd_api.api.maps import create_map
from spicd_api.api.objects import get_survey_objects
from spicd_api.api.scans import upload_scan
from spicd_api.api.surveys import create_survey, get_survey_cloud, get_tiles
from spicd_api.models import (
    AcceptedMap,
    AcceptedSurvey,
    JobDocument,
    MapRequest,
    ScanDocument,
    SightingCollection,
    SurveyRequest,
    TileCollection,
)
from spicd_api.types import UNSET, File

T = TypeVar("T")


def main() -> None:
    """Build a map of some scans, compare another one with it, and print what changed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument(
        "scans", type=Path, nargs="+", help="of the map; a pose (4x4, JSON) may lie in SCAN.json"
    )
    parser.add_argument("--visit", type=Path, required=True, help="a later scan")
    parser.add_argument("--cloud", type=Path, default=Path("changes.ply"), help="written anew")
    told = parser.parse_args()
    with AuthenticatedClient(told.url, token=os.environ.get("SPICD_KEY", "none"), timeout=60) as client:
        scan_ids = [sent(client, path) for path in told.scans]
        request = MapRequest(scan_ids=scan_ids, name="made by a generated client")
        made = expected(AcceptedMap, create_map.sync(client=client, body=request, idempotency_key=new_key()))
        wait(client, made.job_id)
        report(client, made.map_id, sent(client, told.visit), told.cloud)


def sent(client: AuthenticatedClient, path: Path) -> str:
    """Upload a scan, and return its id."""
    beside = path.with_suffix(".json")
    pose = beside.read_text() if beside.exists() else UNSET
    with path.open("rb") as file:
        scan = upload_scan.sync(client=client, body=File(payload=file), filename=path.name, pose=pose)
    return str(expected(ScanDocument, scan).scan_id)


def wait(client: AuthenticatedClient, job_id: str) -> None:
    """Return when a job was successful."""
    while True:
        job = expected(JobDocument, get_job.sync(job_id, client=client, wait=20))
        if job.status in ("failed", "dismissed"):
            raise SystemExit(f"job {job_id}: {job.problem}")
        if job.status == "successful":
            return


def report(client: AuthenticatedClient, map_id: str, scan_id: str, cloud: Path) -> None:
    """Compare a scan with a map, print what changed, and write the coloured cloud."""
    body = SurveyRequest(scan_ids=[scan_id])
    accepted = create_survey.sync(map_id, client=client, body=body, idempotency_key=new_key())
    survey_id = expected(AcceptedSurvey, accepted).survey_id
    wait(client, expected(AcceptedSurvey, accepted).job_id)
    tiles = expected(TileCollection, get_tiles.sync(survey_id, client=client))
    changes = expected(TileCollection, get_changes.sync(map_id, client=client, min_score=0.5))
    things = expected(SightingCollection, get_survey_objects.sync(survey_id, client=client))
    for thing in things.features:
        print(f"{thing.id}: {thing.properties.kind}, {thing.properties.probability:.2f}")
    print(f"{len(tiles.features)} tiles, {changes.number_matched} changes, {len(things.features)} objects")
    cloud.write_bytes(expected(File, get_survey_cloud.sync(survey_id, client=client)).payload.read())


def expected(kind: type[T], answer: object) -> T:
    """Return an answer of that kind; anything else is a problem document, and ends the program."""
    if not isinstance(answer, kind):
        raise SystemExit(f"the service answered {answer}")
    return answer


def new_key() -> str:
    """Return an Idempotency-Key: who sends a request again, with the same one, makes nothing twice."""
    return str(uuid.uuid4())


if __name__ == "__main__":
    main()
