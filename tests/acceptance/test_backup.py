"""A copy taken while surveys run makes a service in which they go on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import until
from tests.support.running_service import ROOT, Service
from tests.support.two_visits import Visits


def spicd(*words: str) -> None:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("SPICD_")}
    command = [sys.executable, "-m", "service", *words]
    subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=60)


@pytest.mark.timeout(400)
def test_a_copy_taken_while_surveys_run_is_whole_and_they_go_on(
    tmp_path: Path, model_store: Path, visits: Visits
) -> None:
    (tmp_path / "first").mkdir()
    (tmp_path / "second").mkdir()
    service = Service(tmp_path / "first", model_store)
    try:
        scans = [service.upload(path, pose=pose) for path, pose in visits.first]
        service.succeeded(service.post("/maps", id="room", scan_ids=scans)["job_id"])
        later = service.upload(visits.second[0], pose=visits.second[1])
        done, *open_ones = (
            service.post("/maps/room/surveys", scan_ids=[later], threshold=threshold)
            for threshold in (0.3, 0.4, 0.5)
        )
        service.succeeded(done["job_id"])
        until(lambda: service.get(f"/jobs/{open_ones[0]['job_id']}")["status"] != "accepted", 60)
        spicd("backup", str(tmp_path / "copy"), "--data-dir", str(tmp_path / "first/data"))
        cloud = service.http.get(f"/surveys/{done['survey_id']}/cloud.ply").content
    finally:
        service.end()
    spicd("restore", str(tmp_path / "copy"), "--data-dir", str(tmp_path / "second/data"))
    restored = Service(tmp_path / "second", model_store)
    try:
        assert restored.http.get(f"/surveys/{done['survey_id']}/cloud.ply").content == cloud
        for survey in open_ones:
            restored.succeeded(survey["job_id"])
        assert restored.get("/maps/room/surveys")["surveys"]
    finally:
        restored.end()
