"""Clients that generators made of the OpenAPI document do their part against a service, unedited."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.running_service import ROOT, Service
from tests.support.tools import TOOLS, needs_tools, run
from tests.support.traffic import Room, Upload
from worker.cloud.formats.scan import read_scan
from worker.detectors.card import MODEL_STORE

DOCUMENT, SETTINGS = ROOT / "openapi" / "openapi.json", ROOT / "openapi" / "python-client.yaml"

pytestmark = [needs_tools, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    service = Service(tmp_path_factory.mktemp("generated"), MODEL_STORE)
    yield service
    service.end()


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    """Files of a map and of a visit, each with its pose beside it."""
    folder, room = tmp_path_factory.mktemp("scans"), Room()

    def written(upload: Upload) -> Path:
        path = folder / upload.name
        path.write_bytes(upload.content)
        path.with_suffix(".json").write_text(upload.pose)
        return path

    return [written(upload) for upload in room.map_uploads()], written(room.survey_upload(0))


@pytest.fixture(scope="module")
def said(
    service: Service, scans: tuple[list[Path], Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    """What the generated client printed, and the cloud that it wrote."""
    folder, (first, visit) = tmp_path_factory.mktemp("python"), scans
    words = (
        "--path",
        DOCUMENT,
        "--config",
        SETTINGS,
        "--output-path",
        folder / "spicd_api",
        "--meta",
        "none",
    )
    run("openapi-python-client", "generate", *words, "--fail-on-warning")
    (folder / "generated_client.py").write_text((ROOT / "examples" / "generated_client.py").read_text())
    cloud = folder / "changes.ply"
    told: tuple[str | Path, ...] = (
        "generated_client.py",
        service.url,
        *first,
        "--visit",
        visit,
        "--cloud",
        cloud,
    )
    return run("python", *told, cwd=folder, timeout_s=500), cloud


def test_the_python_client_does_the_main_job(service: Service, said: tuple[str, Path]) -> None:
    printed, cloud = said
    (survey,) = service.get(f"/maps/{service.get('/maps')['maps'][0]['map_id']}/surveys")["surveys"]
    assert survey["status"] == "ready"
    tiles = service.get(f"/surveys/{survey['survey_id']}/tiles")
    assert f"{len(tiles['features'])} tiles" in printed.splitlines()[-1]
    assert len(read_scan(cloud).points) > 5_000


def test_the_types_and_a_fetch_of_other_people_make_a_dashboard(
    service: Service, said: tuple[str, Path], tmp_path: Path
) -> None:
    run("openapi-typescript", DOCUMENT, "-o", tmp_path / "spicd.ts")
    (tmp_path / "dashboard.ts").write_text((ROOT / "examples" / "dashboard.ts").read_text())
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "node_modules").symlink_to(TOOLS / "node_modules")
    words = ("--strict", "--target", "es2022", "--module", "nodenext", "--lib", "es2022,dom")
    run("tsc", *words, "dashboard.ts", cwd=tmp_path)
    job = service.get("/jobs")["jobs"][0]
    answer: Any = json.loads(run("node", "dashboard.js", service.url, job["jobID"], cwd=tmp_path))
    map_id = job["map_id"]
    changes = service.get(f"/maps/{map_id}/changes?limit=1000")["features"]
    assert answer["job"] == "successful"
    assert answer["maps"] == {
        map_id: [f"{one['properties']['tile_id']} {one['properties']['state']}" for one in changes]
    }
