"""/jobs: OGC API - Processes status documents, and dismissal."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.records import Problem
from service.settings import Settings
from tests.support.samples import RememberingQueue, add_map, add_survey, catalog_of, running


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
        "links": [{"href": f"/jobs/{job_id}", "rel": "self", "type": "application/json"}],
    }


def test_a_job_that_runs_shows_its_stage_and_share(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog, ready=False)
    catalog.jobs.start(job_id)
    catalog.jobs.report(job_id, message="registration", progress=0.4)
    job = client.get(f"/jobs/{job_id}").json()
    assert (job["status"], job["message"], job["progress"]) == ("running", "registration", 40)
    assert job["started"].endswith("Z")


def test_a_finished_job_links_to_its_result(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog)
    job = client.get(f"/jobs/{job_id}").json()
    assert (job["status"], job["progress"], job["processID"]) == ("successful", 100, "survey")
    (result,) = [link["href"] for link in job["links"] if link["rel"].endswith("/results")]
    assert result == f"/surveys/{survey_id}"


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


def test_a_start_submits_again_what_is_unfinished_and_not_in_the_queue(settings: Settings) -> None:
    with running(settings, RememberingQueue()) as client:
        catalog = catalog_of(client)
        first, begun, held, last = (add_map(catalog, name, ready=False) for name in ("a", "b", "c", "d"))
        for job_id in (begun, held):
            catalog.jobs.start(job_id)
        add_map(catalog, "done")
    queue = RememberingQueue(held={held})
    with running(settings, queue) as client:
        assert queue.submitted == [(first, "map"), (begun, "map"), (last, "map")]
        messages = {job["jobID"]: job["message"] for job in client.get("/jobs").json()["jobs"]}
        assert messages[begun] == "started again (2 of 3): the service ended while it ran"
        assert messages[first] == "waiting"


def test_a_job_that_runs_at_the_third_end_of_the_service_is_given_up(settings: Settings) -> None:
    with running(settings, RememberingQueue()) as client:
        job_id = add_map(catalog_of(client), ready=False)
        catalog_of(client).jobs.start(job_id)
    queue = RememberingQueue()
    for _ in range(3):
        with running(settings, queue) as client:
            job = client.get(f"/jobs/{job_id}").json()
    assert queue.submitted == [(job_id, "map")] * 2
    assert (job["status"], job["problem"]["type"]) == ("failed", "urn:spicd:problem:worker_died")
    assert "3 attempts" in job["problem"]["detail"]


def test_a_start_without_a_queue_serves_all_the_same(settings: Settings) -> None:
    with running(settings, RememberingQueue()) as client:
        add_map(catalog_of(client), ready=False)
    with running(settings, RememberingQueue(down=True)) as client:
        assert client.get("/jobs").json()["jobs"][0]["status"] == "accepted"
