"""/maps/{id}/versions: a map stays in use while a newer version of it builds, and surveys keep theirs."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.catalog.records import Problem, ScanOutcome
from tests.support.samples import (
    NOON,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    add_version,
    ply,
    tile,
)

PROBLEM = Problem(code="map_failed", detail="no scan holds a pose")


def accept_scans(catalog: Catalog, survey_id: str) -> list[ScanOutcome]:
    """What registration would have recorded of the survey's scans."""
    pose = ((1, 0, 0, 2.5), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    scans = [
        ScanOutcome(
            scan_id=scan.scan_id,
            accepted=True,
            fitness=0.9,
            map_from_scan=pose,
            translation_sigma=0.004,
            rotation_sigma=0.001,
        )
        for scan in catalog.surveys.get(survey_id).scans
    ]
    catalog.surveys.save_outcomes(survey_id, scans)
    return scans


def post(client: TestClient, **asked: Any) -> httpx.Response:
    answer: httpx.Response = client.post("/maps/lobby/versions", json=asked)
    return answer


def shown(client: TestClient) -> Any:
    found = client.get("/maps/lobby").json()
    return found["version"], found["status"], found["counts"]


def test_a_version_of_further_scans_is_accepted_and_its_job_submitted(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    (kept,) = catalog.maps.get("lobby").scans
    further = add_scan(catalog, "further")
    answer = post(client, scan_ids=[further.scan_id])
    assert answer.status_code == 202
    accepted = answer.json()
    assert (accepted["map_id"], accepted["version"], accepted["status"]) == ("lobby", 2, "building")
    assert answer.headers["location"] == f"/jobs/{accepted['job_id']}"
    assert queue.submitted == [(accepted["job_id"], "register")]
    hrefs = {link["rel"]: link["href"] for link in accepted["links"]}
    found = client.get(hrefs["self"]).json()
    assert (found["version"], found["base_version"], found["survey_id"]) == (2, 1, None)
    assert [scan["scan_id"] for scan in found["scans"]] == [kept.scan_id, further.scan_id]
    assert found["scans"][0] == kept.model_dump(mode="json")  # with its pose
    assert found["scans"][1]["accepted"] is None
    assert client.get(f"/jobs/{accepted['job_id']}").json()["map_id"] == "lobby"


def test_a_version_of_files_keeps_them_as_scans(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    files = [("scans", (f"{name}.ply", ply(name))) for name in ("b", "a")]
    answer = client.post("/maps/lobby/versions", data={"device_id": "robot-7"}, files=files)
    assert answer.status_code == 202
    scans = [catalog.scans.get(scan.scan_id) for scan in catalog.versions.get("lobby", 2).scans]
    assert [scan.filename for scan in scans] == ["map-lobby.ply", "b.ply", "a.ply"]
    assert [scan.device_id for scan in scans] == [None, "robot-7", "robot-7"]


def test_a_version_of_an_accepted_survey_takes_its_scans_over_with_their_poses(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    scans = accept_scans(catalog, survey_id)
    answer = post(client, survey_id=survey_id)
    assert answer.status_code == 202
    assert queue.submitted == [(answer.json()["job_id"], "register")]
    found = client.get("/maps/lobby/versions/2").json()
    assert (found["base_version"], found["survey_id"]) == (1, survey_id)
    assert found["scans"][1:] == [scan.model_dump(mode="json") for scan in scans]


def test_a_map_stays_in_use_while_a_version_builds_and_shows_it_when_it_is_ready(
    client: TestClient, catalog: Catalog
) -> None:
    first = add_map(catalog)
    second = add_version(catalog, ready=False)
    catalog.jobs.begin(second, "register")
    assert shown(client) == (1, "ready", {"tiles": 4})
    for job_id, content in ((first, b"ply one"), (second, b"ply two")):
        catalog.blobs.put_bytes(blob_keys.map_cloud(job_id), content)
        catalog.blobs.put_bytes(blob_keys.map_laz(job_id), b"laz" + content[3:])
        catalog.blobs.put_bytes(blob_keys.map_manifest(job_id), b'"%s"' % content)
    assert client.get("/maps/lobby/cloud.ply").content == b"ply one"
    assert client.get("/maps/lobby/versions/2/cloud.ply").status_code == 409
    catalog.jobs.succeed(second)
    assert shown(client)[:2] == (2, "ready")
    for path, content in (("", b"two"), ("/versions/1", b"one"), ("/versions/2", b"two")):
        assert client.get(f"/maps/lobby{path}/cloud.ply").content == b"ply " + content
        assert client.get(f"/maps/lobby{path}/cloud.laz").content == b"laz " + content
        assert client.get(f"/maps/lobby{path}/manifest").json() == f"ply {content.decode()}"


@pytest.mark.parametrize("how", ["failed", "dismissed"])
def test_a_version_that_came_to_nothing_leaves_the_map_as_it_was(
    client: TestClient, catalog: Catalog, how: str
) -> None:
    add_map(catalog)
    before = client.get("/maps/lobby").json()
    job_id = add_version(catalog, ready=False)
    if how == "failed":
        catalog.jobs.fail(job_id, PROBLEM)
    else:
        client.delete(f"/jobs/{job_id}")
    assert client.get("/maps/lobby").json() == before
    failed = client.get("/maps/lobby/versions/2").json()
    assert (failed["status"], failed["problem"]["type"].rsplit(":", 1)[1]) == (
        "failed",
        "map_failed" if how == "failed" else "dismissed",
    )
    further = post(client, scan_ids=[add_scan(catalog, "again").scan_id])
    assert (further.status_code, further.json()["version"]) == (202, 3)
    assert catalog.versions.get("lobby", 3).base_version == 1


def test_one_version_builds_at_a_time_and_the_refusal_names_it(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    job_id = add_version(catalog, ready=False)
    answer = client.post("/maps/lobby/versions", files={"scans": ("a.ply", ply("new"))})
    assert answer.status_code == 409
    assert answer.json()["type"] == "urn:spicd:problem:conflict"
    assert "version 2 of map 'lobby'" in answer.json()["detail"]
    assert job_id in answer.json()["detail"]
    assert "a.ply" not in [scan.filename for scan in catalog.scans.page().items]


@pytest.mark.parametrize("ended", [False, True])
def test_a_map_that_has_no_version_to_go_on_from_is_not_ready(
    client: TestClient, catalog: Catalog, ended: Any
) -> None:
    job_id = add_map(catalog, ready=False)
    if ended:
        catalog.jobs.fail(job_id, PROBLEM)
    answer = client.post("/maps/lobby/versions", files={"scans": ("a.ply", ply())})
    assert answer.status_code == 409
    assert answer.json()["type"] == f"urn:spicd:problem:{'failed' if ended else 'not_ready'}"
    assert job_id in answer.json()["detail"]


def test_a_survey_of_another_map_or_of_none_is_not_found(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_map(catalog, "hall")
    foreign, _ = add_survey(catalog, [tile(0, 0)], map_id="hall")
    for survey_id in (foreign, "survey-none"):
        answer = post(client, survey_id=survey_id)
        assert (answer.status_code, survey_id in answer.json()["detail"]) == (404, True)


@pytest.mark.parametrize("ended", [False, True])
def test_a_survey_without_a_result_cannot_be_taken_over(
    client: TestClient, catalog: Catalog, ended: Any
) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    if ended:
        catalog.jobs.fail(job_id, PROBLEM)
    answer = post(client, survey_id=survey_id)
    assert answer.status_code == 409
    assert answer.json()["type"] == f"urn:spicd:problem:{'failed' if ended else 'not_ready'}"
    assert job_id in answer.json()["detail"]


def test_a_survey_is_taken_over_once(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    accept_scans(catalog, survey_id)
    add_version(catalog, survey_id=survey_id)
    answer = post(client, survey_id=survey_id)
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:spicd:problem:conflict")


def test_a_version_needs_scans_or_a_survey_and_not_both(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    further = add_scan(catalog, "further").scan_id
    for asked in ({}, {"scan_ids": [further], "survey_id": survey_id}):
        answer = post(client, **asked)
        assert (answer.status_code, answer.json()["type"]) == (422, "urn:spicd:problem:bad_request")


def test_a_scan_of_the_version_in_use_is_refused_and_one_that_was_left_out_may_come_again(
    client: TestClient, catalog: Catalog
) -> None:
    job_id = add_map(catalog)
    (kept,) = catalog.maps.get("lobby").scans
    answer = post(client, scan_ids=[kept.scan_id])
    assert (answer.status_code, kept.scan_id in answer.json()["detail"]) == (422, True)
    catalog.versions.save_outcomes(
        job_id, [ScanOutcome(scan_id=kept.scan_id, accepted=False, reason="no_fit")]
    )
    assert post(client, scan_ids=[kept.scan_id]).status_code == 202
    (again,) = catalog.versions.get("lobby", 2).scans
    assert again.accepted is None


def test_when_the_queue_is_down_no_version_stays_recorded(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    queue.down = True
    answer = client.post("/maps/lobby/versions", files={"scans": ("a.ply", ply())})
    assert answer.status_code == 503
    assert len(client.get("/maps/lobby/versions").json()["versions"]) == 1
    assert len(catalog.jobs.page().items) == 1
    assert [scan.filename for scan in catalog.scans.page().items] == ["map-lobby.ply"]
    queue.down = False
    assert client.post("/maps/lobby/versions", files={"scans": ("a.ply", ply())}).json()["version"] == 2


def test_versions_are_listed_newest_first_page_by_page(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    add_map(catalog, "hall")
    for _ in range(4):
        add_version(catalog)
    url: str | None = "/maps/lobby/versions?limit=2"
    seen = []
    while url:
        body = client.get(url).json()
        seen.append([found["version"] for found in body["versions"]])
        url = next((link["href"] for link in body["links"] if link["rel"] == "next"), None)
    assert seen == [[5, 4], [3, 2], [1]]


def test_a_survey_keeps_the_version_that_was_in_use_when_it_was_asked_for(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    early, job_id = add_survey(catalog, ready=False)
    add_version(catalog)
    late, _ = add_survey(catalog, [tile(2, 0)], captured_at=NOON + timedelta(days=1))
    catalog.surveys.save_result(early, tiles=[tile(1, 0)], threshold=0.5)
    catalog.jobs.succeed(job_id)
    assert [client.get(f"/surveys/{each}").json()["map_version"] for each in (early, late)] == [1, 2]
    features = client.get("/maps/lobby/changes").json()["features"]
    assert [one["properties"]["map_version"] for one in features] == [2, 1]
    (one,) = client.get(f"/surveys/{early}/tiles").json()["features"]
    assert one["properties"]["map_version"] == 1


def test_a_deleted_version_takes_its_files_and_job_and_leaves_the_surveys_compared_with_it(
    client: TestClient, catalog: Catalog
) -> None:
    first = add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(1, 0)])
    second = add_version(catalog)
    for job_id in (first, second):
        catalog.blobs.put_bytes(blob_keys.map_cloud(job_id), b"ply")
    catalog.blobs.put_bytes(blob_keys.survey_cloud(survey_id), b"ply")
    assert client.delete("/maps/lobby/versions/1").status_code == 204
    for path in ("/maps/lobby/versions/1", "/maps/lobby/versions/1/cloud.ply", f"/jobs/{first}"):
        assert client.get(path).status_code == 404
    assert not catalog.blobs.exists(blob_keys.map_cloud(first))
    assert client.get("/maps/lobby/cloud.ply").status_code == 200
    assert client.get(f"/surveys/{survey_id}").json()["map_version"] == 1
    assert client.get(f"/surveys/{survey_id}/cloud.ply").status_code == 200
    assert client.get("/maps/lobby/changes").json()["numberMatched"] == 1
    assert [found["version"] for found in client.get("/maps/lobby/versions").json()["versions"]] == [2]
    assert client.delete("/maps/lobby/versions/1").status_code == 404


def test_a_version_that_is_needed_is_not_deleted(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    assert client.delete("/maps/lobby/versions/1").status_code == 409  # in use
    _, job_id = add_survey(catalog, ready=False)
    add_version(catalog)
    assert client.delete("/maps/lobby/versions/1").status_code == 409  # a survey is being compared with it
    catalog.jobs.dismiss(job_id)
    add_version(catalog, ready=False)
    assert client.delete("/maps/lobby/versions/3").status_code == 409  # it builds
    assert client.delete("/maps/lobby/versions/1").status_code == 204


def test_a_survey_stays_while_a_version_is_built_of_it(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(1, 0)])
    accept_scans(catalog, survey_id)
    job_id = add_version(catalog, survey_id=survey_id, ready=False)
    answer = client.delete(f"/surveys/{survey_id}")
    assert (answer.status_code, job_id in answer.json()["detail"]) == (409, True)
    catalog.jobs.succeed(job_id)
    assert client.delete(f"/surveys/{survey_id}").status_code == 204
    assert client.get("/maps/lobby/versions/2").json()["survey_id"] == survey_id


def test_a_deleted_map_takes_the_files_of_all_its_versions(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    jobs = [add_map(catalog), add_version(catalog), add_version(catalog, ready=False)]
    for job_id in jobs:
        catalog.blobs.put_bytes(blob_keys.map_cloud(job_id), b"ply")
    assert client.delete("/maps/lobby").status_code == 204
    assert queue.dismissed == [(jobs[2], "map")]
    assert not any(catalog.blobs.exists(blob_keys.map_cloud(job_id)) for job_id in jobs)
    assert client.get("/maps/lobby/versions").status_code == 404
    catalog.scans.delete(next(s.scan_id for s in catalog.scans.page().items if s.filename == "map-lobby.ply"))


@pytest.mark.parametrize("number", ["0", "-1", "x", "99999999999999999999"])
def test_a_number_that_no_version_has_is_refused(client: TestClient, catalog: Catalog, number: Any) -> None:
    add_map(catalog)
    assert client.get(f"/maps/lobby/versions/{number}").status_code == 422
    assert client.get("/maps/lobby/versions/7").status_code == 404
