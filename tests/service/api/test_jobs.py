"""/jobs: OGC API - Processes status documents, and dismissal."""

from __future__ import annotations

import threading
from contextlib import closing
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from httpx import Response

from service.catalog.catalog import Catalog, open_catalog
from service.catalog.records import Problem
from service.queue import Claim, QueueState
from service.settings import Settings
from tests.support.live import live
from tests.support.processes import until
from tests.support.samples import RememberingQueue, add_map, add_scan, add_survey, catalog_of, running


def test_a_job_that_waits_is_an_ogc_status_document(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    job = client.get(f"/jobs/{job_id}").json()
    assert job.pop("created") == job.pop("updated")
    assert job == {
        "jobID": job_id,
        "processID": "map",
        "type": "process",
        "status": "accepted",
        "message": "waiting",
        "progress": 0,
        "started": None,
        "finished": None,
        "map_id": "lobby",
        "survey_id": None,
        "model": None,
        "problem": None,
        "step": "register",
        "attempts": 0,
        "interruptions": 0,
        "queue_position": 1,
        "waiting_s": job["waiting_s"],
        "links": [{"href": f"/jobs/{job_id}", "rel": "self", "type": "application/json"}],
    }


def test_a_job_that_runs_shows_its_stage_and_share(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    run = catalog.jobs.begin(job_id, "register")
    assert run is not None
    catalog.jobs.report(run, message="registration", progress=0.4)
    job = client.get(f"/jobs/{job_id}").json()
    assert (job["status"], job["message"], job["progress"]) == ("running", "registration", 40)
    assert job["started"].endswith("Z")


def test_a_finished_job_links_to_its_result(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog)
    job = client.get(f"/jobs/{job_id}").json()
    assert (job["status"], job["progress"], job["processID"]) == ("successful", 100, "survey")
    (result,) = [link["href"] for link in job["links"] if link["rel"] == "related"]
    assert result == f"/surveys/{survey_id}"
    (results,) = [link["href"] for link in job["links"] if link["rel"].endswith("/results")]
    assert client.get(results).json()["survey"]["href"] == result


@pytest.mark.parametrize("code", ["registration_failed", "scan_unreadable", "internal", "something_new"])
def test_a_failed_job_carries_its_problem(client: TestClient, catalog: Catalog, code: str) -> None:
    job_id = add_map(catalog, ready=False)
    catalog.jobs.fail(job_id, Problem(code=code, detail="scan hall.pcd: fitness 0.12 is below 0.55"))
    problem = client.get(f"/jobs/{job_id}").json()["problem"]
    assert problem["type"] == f"urn:spicd:problem:{code}"
    assert problem["title"]
    assert problem["detail"] == "scan hall.pcd: fitness 0.12 is below 0.55"
    assert client.get("/maps/lobby").json()["problem"] == problem


def test_a_dismissed_job_stays_dismissed_and_answers_the_same_again(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    job_id = add_map(catalog, ready=False)
    first = client.delete(f"/jobs/{job_id}")
    assert (first.status_code, first.json()["status"]) == (200, "dismissed")
    assert not catalog.jobs.succeed(job_id)
    assert client.delete(f"/jobs/{job_id}").json() == first.json()
    assert queue.dismissed[0] == (job_id, "map")
    assert client.get("/maps/lobby").json()["status"] == "failed"


def test_a_dismissal_stands_without_a_queue(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    job_id = add_map(catalog, ready=False)
    queue.down = True
    assert client.delete(f"/jobs/{job_id}").status_code == 200
    assert catalog.jobs.get(job_id).status == "dismissed"


def test_a_job_that_ended_by_itself_cannot_be_dismissed(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    job_id = add_map(catalog)
    answer = client.delete(f"/jobs/{job_id}")
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:spicd:problem:conflict")
    assert client.get(f"/jobs/{job_id}").json()["status"] == "successful"
    assert queue.dismissed == []


def test_jobs_are_listed_by_state_and_map(client: TestClient, catalog: Catalog) -> None:
    waiting = add_map(catalog, ready=False)
    done = add_map(catalog, "hall")
    for asked, ids in (
        ({}, [done, waiting]),
        ({"status": "accepted"}, [waiting]),
        ({"map_id": "hall"}, [done]),
        ({"map_id": "hall", "status": "failed"}, []),
    ):
        assert [job["jobID"] for job in client.get("/jobs", params=asked).json()["jobs"]] == ids


def test_a_start_hands_over_what_is_unfinished_and_nobody_holds(settings: Settings) -> None:
    with running(settings, RememberingQueue()) as client:
        catalog = catalog_of(client)
        first, begun, held, last = (add_map(catalog, name, ready=False) for name in ("a", "b", "c", "d"))
    with closing(open_catalog(settings)) as catalog:  # the service is down
        for job_id in (begun, held):
            assert catalog.jobs.begin(job_id, "register")
        add_map(catalog, "done")
    claim = Claim(step=f"{held}-register", execution="1", worker="w1")
    queue = RememberingQueue(state=QueueState(answering=tuple("abcd"), claims=(claim,)))
    with running(settings, queue) as client:
        until(lambda: len(queue.submitted) == 3)
        assert set(queue.submitted) == {(job_id, "register") for job_id in (first, begun, last)}
        messages = {job["jobID"]: job["message"] for job in client.get("/jobs").json()["jobs"]}
        assert messages[begun].startswith("interrupted, goes on with the next worker that is free")
        assert messages[first] == messages[held] == "waiting"


def test_a_job_that_waits_tells_its_place_and_for_how_long(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    build = add_map(catalog, "hall", ready=False)
    surveys = [add_survey(catalog, ready=False)[1] for _ in range(2)]
    jobs = {job["jobID"]: job for job in client.get("/jobs").json()["jobs"]}
    assert [jobs[job_id]["queue_position"] for job_id in (*surveys, build)] == [1, 2, 3]
    assert jobs[build]["waiting_s"] >= jobs[surveys[1]]["waiting_s"] >= 0
    assert catalog.jobs.begin(surveys[0], "register")
    begun = client.get(f"/jobs/{surveys[0]}").json()
    assert (begun["queue_position"], begun["waiting_s"], begun["step"]) == (None, None, "register")
    assert client.get(f"/jobs/{surveys[1]}").json()["queue_position"] == 1


def test_no_more_jobs_wait_than_may(settings: Settings, tmp_path: Path) -> None:
    few = settings.model_copy(update={"max_waiting_jobs": 3, "max_waiting_jobs_per_device": 2})
    with running(few, RememberingQueue()) as client:
        catalog = catalog_of(client)
        add_map(catalog)
        scan = add_scan(catalog, "visit")

        def submit(device: str) -> Response:
            body = {"scan_ids": [scan.scan_id], "device_id": device}
            return client.post("/maps/lobby/surveys", json=body)

        assert [submit("robot-1").status_code for _ in range(3)] == [202, 202, 429]
        assert "robot-1" in submit("robot-1").json()["detail"]
        assert [submit("robot-2").status_code for _ in range(2)] == [202, 429]
        refused = submit("robot-2")
        assert refused.json()["type"] == "urn:spicd:problem:queue_full"
        assert len(client.get("/maps/lobby/surveys").json()["surveys"]) == 3


def test_a_start_without_a_queue_serves_all_the_same(settings: Settings) -> None:
    with running(settings, RememberingQueue()) as client:
        add_map(catalog_of(client), ready=False)
    with running(settings, RememberingQueue(down=True)) as client:
        assert client.get("/jobs").json()["jobs"][0]["status"] == "accepted"


def test_a_failed_job_is_run_again_on_request(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    catalog.jobs.fail(job_id, Problem(code="disk_full", detail="the disk is full"))
    queue.submitted.clear()
    answer = client.post(f"/jobs/{job_id}/retry")
    assert (answer.status_code, answer.json()["status"], answer.json()["problem"]) == (202, "accepted", None)
    assert answer.headers["Location"] == f"/jobs/{job_id}"
    assert queue.submitted == [(job_id, "register")]
    assert client.get(f"/surveys/{survey_id}").json()["status"] == "running"
    catalog.jobs.dismiss(job_id)
    assert client.post(f"/jobs/{job_id}/retry").status_code == 409


def test_who_waits_for_a_job_is_answered_when_it_has_ended(settings: Settings) -> None:
    """Its answer comes long before the time is over, also where other jobs of the map end meanwhile."""
    with live(settings) as service:
        catalog = service.services.catalog
        add_map(catalog)
        _, job_id = add_survey(catalog, ready=False)

        def end() -> None:
            until(lambda: service.listeners() == 1)
            add_survey(catalog)
            catalog.jobs.succeed(job_id)

        ender = threading.Thread(target=end)
        ender.start()
        answer = service.http.get(f"/jobs/{job_id}", params={"wait": "60"}, timeout=50)
        ender.join()
        assert answer.json()["status"] == "successful"
        assert "Retry-After" not in answer.headers
        until(lambda: service.listeners() == 0)


def test_a_wait_for_a_job_ends_when_its_time_is_over(settings: Settings) -> None:
    with live(settings) as service:
        job_id = add_map(service.services.catalog, ready=False)
        answer = service.http.get(f"/jobs/{job_id}", params={"wait": "0.1"})
        assert answer.json()["status"] == "accepted"
        assert answer.headers["Retry-After"] == "2"


def test_who_waits_for_a_job_that_is_deleted_is_told(settings: Settings) -> None:
    with live(settings) as service:
        catalog = service.services.catalog
        add_map(catalog)
        survey_id, job_id = add_survey(catalog, ready=False)

        def delete() -> None:
            until(lambda: service.listeners() == 1)
            service.http.delete(f"/surveys/{survey_id}")

        deleter = threading.Thread(target=delete)
        deleter.start()
        answer = service.http.get(f"/jobs/{job_id}", params={"wait": "60"}, timeout=50)
        deleter.join()
    # dismissed first, and then gone: which of the two is seen is a matter of time
    assert answer.status_code == 404 or answer.json()["status"] == "dismissed"


def test_a_wait_is_at_most_a_minute(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    assert client.get(f"/jobs/{job_id}", params={"wait": "61"}).status_code == 422
    assert client.get(f"/jobs/{job_id}").headers["Retry-After"] == "2"


def test_the_problem_of_a_job_has_the_members_of_any_problem(client: TestClient, catalog: Catalog) -> None:
    """What it does not have is left out, and not null."""
    job_id = add_map(catalog, ready=False)
    catalog.jobs.fail(job_id, Problem(code="map_failed", detail="the scans do not meet"))
    assert set(client.get(f"/jobs/{job_id}").json()["problem"]) == {"type", "title", "detail"}
