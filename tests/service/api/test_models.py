"""Models: of the release, and the site's own, trained on a map."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.catalog.records import Problem
from service.errors import Conflict
from service.settings import Settings
from tests.support.samples import MODEL, RememberingQueue, add_map, add_scan, add_version

CARD = {"name": "lobby-net", "version": "1", "threshold": 0.3}


def post(client: TestClient, map_id: str = "lobby", **body: Any) -> httpx.Response:
    answer: httpx.Response = client.post(f"/maps/{map_id}/models", json=body)
    return answer


def add_model(catalog: Catalog, *, ready: bool = True, name: str | None = None) -> str:
    """A model of the map `lobby`, trained or not; its job's id."""
    record, job = catalog.models.create("lobby", minutes=5, name=name)
    if ready:
        catalog.models.save_card(job.job_id, {**CARD, "name": record.name, "version": str(record.version)})
        catalog.jobs.succeed(job.job_id)
    return job.job_id


def code(answer: httpx.Response) -> str:
    kind: str = answer.json()["type"]
    return kind.rsplit(":", 1)[1]


def test_a_training_is_recorded_and_handed_to_the_queue(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    answer = post(client, base=MODEL, minutes=3, epochs=7)
    assert answer.status_code == 202
    accepted = answer.json()
    assert answer.headers["location"] == f"/jobs/{accepted['job_id']}"
    assert queue.submitted == [(accepted["job_id"], "pack")]
    assert (accepted["model"], accepted["map_version"], accepted["status"]) == ("lobby-net/1", 1, "training")
    job = client.get(f"/jobs/{accepted['job_id']}").json()
    assert (job["processID"], job["map_id"], job["model"]) == ("model", "lobby", "lobby-net/1")
    kept = catalog.models.of_job(accepted["job_id"])
    assert (kept.base, kept.minutes, kept.epochs) == (MODEL, 3, 7)


def test_versions_of_a_name_are_counted_and_names_may_be_given(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    models = [post(client, **body).json()["model"] for body in ({}, {}, {"name": "night"})]
    assert models == ["lobby-net/1", "lobby-net/2", "night/1"]


def test_what_is_left_out_is_from_nothing_and_takes_the_services_minutes(
    client: TestClient, catalog: Catalog, settings: Settings
) -> None:
    add_map(catalog)
    kept = catalog.models.of_job(post(client).json()["job_id"])
    assert (kept.base, kept.minutes, kept.epochs) == (None, settings.training_minutes, None)


@pytest.mark.parametrize("timeout_s", [3600, 600])
def test_a_training_ends_before_its_step_is_stopped(
    client: TestClient, catalog: Catalog, settings: Settings, timeout_s: int
) -> None:
    add_map(catalog)
    given = settings.model_copy(update={"job_timeout_s": timeout_s})
    most = {3600: 40, 600: 8}[timeout_s]
    assert given.most_training_minutes() == most
    assert most * 60 < timeout_s
    answer = post(client, minutes=40.5)
    assert (answer.status_code, code(answer)) == (422, "bad_request")
    assert "at most 40" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ({"base": "spicd-net/9"}, "bad_request"),
        ({"name": "spicd-net"}, "conflict"),
        ({"name": "a/b"}, "invalid_request"),
        ({"minutes": 0}, "invalid_request"),
        ({"labels": []}, "invalid_request"),
    ],
)
def test_a_request_that_cannot_be_met_leaves_nothing(
    client: TestClient, catalog: Catalog, queue: RememberingQueue, body: Any, problem: str
) -> None:
    add_map(catalog)
    assert code(post(client, **body)) == problem
    assert queue.submitted == []
    assert catalog.models.find("lobby-net") is None


def test_a_map_that_is_not_there_or_not_ready_is_not_trained_on(client: TestClient, catalog: Catalog) -> None:
    assert code(post(client)) == "not_found"
    add_map(catalog, ready=False)
    assert code(post(client)) == "not_ready"


def test_without_a_queue_nothing_is_recorded(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    queue.down = True
    assert code(post(client)) == "queue_unavailable"
    assert catalog.models.find("lobby-net") is None
    assert [job.kind for job in catalog.jobs.page().items] == ["map"]


def test_a_trained_model_stands_among_the_models_and_may_be_named_by_surveys_and_trainings(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    job_id = add_model(catalog)
    assert [card["name"] for card in client.get("/models").json()["models"]] == ["spicd-net", "lobby-net"]
    assert client.get("/models/lobby-net").json() == CARD
    links = {link["rel"]: link for link in client.get(f"/jobs/{job_id}").json()["links"]}
    result = links["related"]
    assert result["href"] == "/models/lobby-net?version=1"
    assert client.get(result["href"]).json() == CARD
    survey = {"scan_ids": [add_scan(catalog, "tuesday").scan_id], "model": "lobby-net/1"}
    assert client.post("/maps/lobby/surveys", json=survey).status_code == 202
    assert post(client, base="lobby-net/1").json()["model"] == "lobby-net/2"


def test_a_model_in_training_is_not_ready_and_one_that_failed_is_told_apart(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    job_id = add_model(catalog, ready=False)
    survey = {"scan_ids": [add_scan(catalog, "tuesday").scan_id], "model": "lobby-net/1"}
    for word, problem in (("still in training", "not_ready"), ("was not made", "failed")):
        for answer in (client.get("/models/lobby-net"), client.post("/maps/lobby/surveys", json=survey)):
            assert (answer.status_code, code(answer)) == (409, problem)
            assert word in answer.json()["detail"]
            assert job_id in answer.json()["detail"]
        catalog.jobs.fail(job_id, Problem(code="training_failed", detail="the map has 2 tiles"))
    assert [card["name"] for card in client.get("/models").json()["models"]] == ["spicd-net"]


def test_the_newest_version_that_is_ready_is_shown_where_none_is_named(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    for _ in range(2):
        add_model(catalog)
    add_model(catalog, ready=False)
    assert client.get("/models/lobby-net").json()["version"] == "2"
    assert client.get("/models/lobby-net", params={"version": "1"}).json()["version"] == "1"
    for version in ("4", "x", "0"):
        assert code(client.get("/models/lobby-net", params={"version": version})) == "not_found"


def test_maps_are_cut_for_models_of_the_release(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_model(catalog)
    answer = client.post("/maps", json={"scan_ids": [add_scan(catalog).scan_id], "model": "lobby-net/1"})
    assert code(answer) == "bad_request"


def test_a_model_goes_with_its_map(client: TestClient, catalog: Catalog, queue: RememberingQueue) -> None:
    add_map(catalog)
    done = add_model(catalog)
    running = add_model(catalog, ready=False)
    catalog.blobs.put_bytes(blob_keys.model_weights(done), b"weights")
    assert client.delete("/maps/lobby").status_code == 204
    assert (running, "model") in queue.dismissed
    assert catalog.models.ready() == ()
    assert not catalog.blobs.exists(blob_keys.model_weights(done))


def test_a_version_that_a_model_is_trained_on_stays(catalog: Catalog) -> None:
    add_map(catalog)
    job_id = add_model(catalog, ready=False)
    add_version(catalog)
    with pytest.raises(Conflict, match="a model is being trained on version 1"):
        catalog.versions.delete("lobby", 1)
    catalog.jobs.dismiss(job_id)
    catalog.versions.delete("lobby", 1)
    assert [found.version for found in catalog.versions.page("lobby").items] == [2]
