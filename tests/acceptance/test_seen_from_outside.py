"""What an operator sees of one survey: metrics, the log of all processes, and traces."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.support.collector import Collector, collecting
from tests.support.running_service import Service
from tests.support.two_visits import Visits

REQUEST = "robot-7.42"


@pytest.fixture(scope="module")
def collector() -> Iterator[Collector]:
    with collecting() as collected:
        yield collected


@pytest.fixture(scope="module")
def service(
    tmp_path_factory: pytest.TempPathFactory, model_store: Path, collector: Collector
) -> Iterator[Service]:
    """It writes its log as JSON and sends its spans."""
    folder = tmp_path_factory.mktemp("seen")
    service = Service(folder, model_store, log_format="json", **collector.environment)
    yield service
    if service.process.poll() is None:
        service.end()


@pytest.fixture(scope="module")
def job_id(service: Service, visits: Visits) -> str:
    """The job of a survey that was asked for under an id, and ended well."""
    ids = [service.upload(path, pose=pose) for path, pose in visits.first]
    service.succeeded(service.post("/maps", id="room", scan_ids=ids)["job_id"])
    path, pose = visits.second
    scan = service.upload(path, pose=pose)
    service.http.headers["X-Request-ID"] = REQUEST
    accepted = service.post("/maps/room/surveys", scan_ids=[scan])
    del service.http.headers["X-Request-ID"]
    service.succeeded(accepted["job_id"])
    return str(accepted["job_id"])


def test_metrics_tell_what_became_of_it(service: Service, job_id: str) -> None:
    found = {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(service.http.get("/metrics").text)
        for sample in family.samples
    }
    assert found["spicd_jobs_ended_total", "survey", "successful"] == 1
    assert found["spicd_scans_registered_total", "survey", "accepted"] == 1
    assert found["spicd_survey_tiles_sum", "voxel-net/1"] > 0
    assert 0 < found["spicd_survey_observed_share_sum", "voxel-net/1"] <= 1
    assert 0.3 < found["spicd_registration_fitness_sum", "survey"] <= 1
    assert found["spicd_queue_depth", "survey", "geometry"] == 0
    assert all(found["spicd_part_up", part] == 1 for part in ("database", "disk", "queue"))
    for step in ("register", "score", "export"):
        assert found["spicd_step_seconds_count", "survey", "successful", step] == 1
        assert 0 < found["spicd_step_seconds_sum", "survey", "successful", step] < 60
        assert 0 <= found["spicd_step_wait_seconds_sum", "survey", "successful", step] < 60
    for queue in ("geometry", "inference"):
        assert found["spicd_workers", queue, "answering"] == 1
        assert found["spicd_workers", queue, "silent"] == 0


def test_the_log_leads_from_the_request_to_every_step_of_its_job(service: Service, job_id: str) -> None:
    lines: list[dict[str, Any]] = [
        json.loads(line) for line in service.log.read_text().splitlines() if line.startswith('{"time"')
    ]
    (submitted,) = [
        line for line in lines if line.get("request_id") == REQUEST and line.get("job_id") == job_id
    ]
    (answered,) = [line for line in lines if line["logger"] == "spicd.requests" and same(line, submitted)]
    assert (answered["route"], answered["status"]) == ("/maps/{map_id}/surveys", 202)
    workers = [line for line in lines if line.get("job_id") == job_id and line["logger"] == "worker"]
    started = [line["message"] for line in workers if line["message"].endswith(" started")]
    assert started == [
        f"{queue}: {job_id}-{step} started"
        for queue, step in (("geometry", "register"), ("inference", "score"), ("geometry", "export"))
    ]


def same(line: dict[str, Any], other: dict[str, Any]) -> bool:
    return bool(line.get("request_id") == other["request_id"])


def test_the_trace_of_the_job_has_its_steps_and_stages(
    service: Service, collector: Collector, job_id: str
) -> None:
    request = collector.named("POST /maps/{map_id}/surveys")
    collector.named("step export_survey")
    (link,) = request.links
    of_job = [span for span in collector.spans if span.trace_id == link.trace_id]
    names = {span.name for span in of_job}
    assert {"step register_survey", "step score_survey", "step export_survey"} <= names
    assert {"stage registering", "stage scoring", "stage exporting"} <= names
