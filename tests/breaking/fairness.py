"""Measures who waits for whom: `python -m tests.breaking.fairness`.

A survey behind the build of a large map; many surveys of one robot, and one each of others that come last. Exit status
1 where a job fails, or where the others wait for more than half of the crowd.
"""

from __future__ import annotations

import argparse
import sys
import time
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tests.support.findings import add_common, show
from tests.support.running_service import ROOT, Service
from tests.support.traffic import Room, send_scan

MAP = "room"


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    with TemporaryDirectory(prefix="spicd-fair-") as folder:
        service = Service(Path(folder), ROOT / "model_store", min_free_bytes=0)
        try:
            rows, document = measured(service, options)
        finally:
            service.end()
    show(rows, document, options.json)
    return 1 if document["wrong"] else 0


def measured(service: Service, options: argparse.Namespace) -> tuple[dict[str, object], dict[str, Any]]:
    """Return the figures as rows of a table, and as a document."""
    room = Room(map_scans=3, views=5)
    service.succeeded(_build(service, MAP, room))
    behind = _behind_a_build(service, room, options.build)
    crowd, others = _crowd(service, room, options.surveys, options.others)
    last = max(*crowd, *others)
    rows: dict[str, object] = {
        f"a survey alone, then behind a build of {options.build} scans": f"{behind['alone_s']:.1f} s, "
        f"{behind['survey_s']:.1f} s; the build took {behind['build_s']:.0f} s in all",
        f"{options.surveys} surveys of one robot, all done after": f"{last:.0f} s",
        "  done after a quarter, half, three quarters of that time": ", ".join(
            str(sum(one <= last * share for one in (*crowd, *others))) for share in (0.25, 0.5, 0.75)
        ),
        f"  {options.others} of others, that came last, done after": f"{min(others):.0f} to {max(others):.0f} s",
    }
    wrong = max(others) > last / 2
    return rows, {**behind, "crowd_s": crowd, "others_s": others, "wrong": wrong}


def _build(service: Service, map_id: str, room: Room) -> str:
    ids = [send_scan(service.http, upload).json()["scan_id"] for upload in room.map_uploads()]
    return str(service.post("/maps", id=map_id, scan_ids=ids)["job_id"])


def _survey(service: Service, room: Room, number: int, device: str) -> str:
    scan = send_scan(service.http, room.survey_upload(number)).json()["scan_id"]
    return str(service.post(f"/maps/{MAP}/surveys", scan_ids=[scan], device_id=device)["job_id"])


def _behind_a_build(service: Service, room: Room, scans: int) -> dict[str, float]:
    """Hand in a survey when a build has worked for some seconds; both ended well, how long did each take."""
    alone = _seconds(service.succeeded(_survey(service, room, 1, "robot-1")))
    build = _build(service, "hall", Room(map_scans=scans, views=1))
    while service.get(f"/jobs/{build}")["progress"] < 12:  # it registers pairs
        time.sleep(0.2)
    survey = _seconds(_ended(service, _survey(service, room, 2, "robot-1")))
    return {"alone_s": alone, "survey_s": survey, "build_s": _seconds(_ended(service, build))}


def _crowd(service: Service, room: Room, many: int, few: int) -> tuple[list[float], list[float]]:
    """Hand in many surveys of one robot, then one each of others; return when each was done, from the first POST on."""
    jobs = [_survey(service, room, 10 + number, "robot-1") for number in range(many)]
    late = [_survey(service, room, 1000 + number, f"robot-{2 + number}") for number in range(few)]
    ended = [_ended(service, job) for job in (*jobs, *late)]
    begun = _instant(ended[0]["created"])
    done = [_instant(job["finished"]) - begun for job in ended]
    return done[:many], done[many:]


def _ended(service: Service, job_id: str) -> dict[str, Any]:
    while (job := service.get(f"/jobs/{job_id}"))["status"] in ("accepted", "running"):
        time.sleep(0.3)
    assert job["status"] == "successful", job
    return dict(job)


def _seconds(job: dict[str, Any]) -> float:
    return _instant(job["finished"]) - _instant(job["created"])


def _instant(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.fairness", description=__doc__)
    parser.add_argument("--build", type=int, default=48, help="scans of the large map")
    parser.add_argument("--surveys", type=int, default=46, help="of one robot")
    parser.add_argument("--others", type=int, default=4, help="robots with a survey each")
    add_common(parser, minutes=15)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
