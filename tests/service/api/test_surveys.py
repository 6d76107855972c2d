"""/surveys: a visit compared with a map that is ready."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.catalog.records import Placement, Problem, ScanOutcome
from service.settings import Settings
from tests.support.samples import IDENTITY, NOON, RememberingQueue, add_map, add_scan, add_survey, ply, tile


def test_a_survey_of_files_is_accepted_and_its_job_submitted(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    form = {"captured_at": "2026-03-01T12:00:00Z", "device_id": "robot-7", "threshold": "0.7"}
    files = [("scans", ("a.ply", ply("a"))), ("scans", ("b.ply", ply("b")))]
    answer = client.post("/maps/lobby/surveys", data=form, files=files)
    assert answer.status_code == 202
    accepted = answer.json()
    assert answer.headers["location"] == f"/jobs/{accepted['job_id']}"
    assert queue.submitted == [(accepted["job_id"], "register")]
    found = client.get(f"/surveys/{accepted['survey_id']}").json()
    assert (found["status"], found["threshold"], found["map_id"]) == ("running", 0.7, "lobby")
    assert found["map_version"] == 1
    assert (found["captured_at"], found["device_id"]) == ("2026-03-01T12:00:00Z", "robot-7")
    assert len(found["scans"]) == 2
    assert catalog.scans.get(found["scans"][0]["scan_id"]).captured_at == NOON


def test_a_survey_of_known_scans_takes_the_model_of_the_map(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    answer = client.post("/maps/lobby/surveys", json={"scan_ids": [add_scan(catalog).scan_id]})
    assert catalog.surveys.get(answer.json()["survey_id"]).model == catalog.maps.get("lobby").model


def test_a_pose_of_a_survey_counts_there_alone(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    named, turned, plain = (add_scan(catalog, name, pose=IDENTITY).scan_id for name in ("a", "b", "c"))
    moved = [[1, 0, 0, 4], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    body = {"scan_ids": [named], "scans": [{"scan_id": turned, "pose": moved}, {"scan_id": plain}]}
    survey_id = client.post("/maps/lobby/surveys", json=body).json()["survey_id"]
    scans = client.get(f"/surveys/{survey_id}").json()["scans"]
    assert [scan["scan_id"] for scan in scans] == [named, turned, plain]
    assert [scan["pose"] for scan in scans] == [[list(row) for row in IDENTITY], moved, scans[0]["pose"]]
    assert catalog.scans.get(turned).pose == IDENTITY
    outcome = ScanOutcome(scan_id=turned, accepted=True)
    catalog.surveys.save_outcomes(survey_id, [outcome])
    shown = client.get(f"/surveys/{survey_id}").json()
    assert shown["scans"][1]["pose"] == moved
    (listed,) = client.get("/maps/lobby/surveys").json()["surveys"]
    for document in (shown, listed):
        assert (document["accepted_count"], document["scan_count"]) == (1, 3)


def test_a_scan_is_named_once_with_a_pose_or_without(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    scan_id = add_scan(catalog).scan_id
    body = {"scan_ids": [scan_id], "scans": [{"scan_id": scan_id}]}
    answer = client.post("/maps/lobby/surveys", json=body)
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:spicd:problem:bad_request")


def test_a_survey_before_its_map_is_ready_is_refused_unread(
    client: TestClient, catalog: Catalog, settings: Settings
) -> None:
    add_map(catalog, ready=False)
    answer = client.post("/maps/lobby/surveys", files={"scans": ("a.ply", ply())})
    assert answer.status_code == 409
    assert answer.json()["type"] == "urn:spicd:problem:not_ready"
    assert [scan.filename for scan in catalog.scans.page().items] == ["map-lobby.ply"]


def test_when_the_queue_is_down_no_survey_stays_recorded(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    queue.down = True
    answer = client.post("/maps/lobby/surveys", files={"scans": ("a.ply", ply())})
    assert answer.status_code == 503
    assert client.get("/maps/lobby/surveys").json()["surveys"] == []
    assert [scan.filename for scan in catalog.scans.page().items] == ["map-lobby.ply"]
    assert len(catalog.jobs.page().items) == 1


def test_the_tiles_are_features_in_the_frame_of_the_map(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    tiles = [
        tile(1, 2, "changed", 0.93, observed_share=0.75),
        tile(0, 0, "unobserved"),
        tile(0, 1, "unchanged", 0.1),
    ]
    survey_id, _ = add_survey(catalog, tiles)
    answer = client.get(f"/surveys/{survey_id}/tiles", params={"profile": "jsonfg"})
    assert answer.headers["content-type"] == "application/vnd.ogc.fg+json"
    found = answer.json()
    assert found["type"] == "FeatureCollection"
    assert found["conformsTo"] == [
        "http://www.opengis.net/spec/json-fg-1/1.0/conf/core",
        "http://www.opengis.net/spec/json-fg-1/1.0/conf/prisms",
    ]
    assert (found["numberMatched"], found["numberReturned"]) == (3, 3)
    unobserved, _, changed = found["features"]
    assert changed["id"] == f"{survey_id}.tile_001_002_000"
    assert changed["geometry"] is None
    assert changed["place"] == {
        "type": "Prism",
        "base": {
            "type": "Polygon",
            "coordinates": [[[1.5, 3.0], [3.0, 3.0], [3.0, 4.5], [1.5, 4.5], [1.5, 3.0]]],
        },
        "lower": 0.0,
        "upper": 1.0,
    }
    assert changed["time"] == {"timestamp": "2026-03-01T12:00:00Z"}
    assert changed["properties"] == {
        "tile_id": "tile_001_002_000",
        "tile_index": [1, 2, 0],
        "center": [2.25, 3.75, 0.5],
        "center_x": 2.25,
        "center_y": 3.75,
        "z_min": 0.0,
        "z_max": 1.0,
        "state": "changed",
        "score": 0.93,
        "probabilities": [pytest.approx(0.07), 0.93, 0],
        "p_unchanged": pytest.approx(0.07),
        "p_changed": 0.93,
        "p_different": 0,
        "threshold": 0.5,
        "n_reference": 900,
        "n_current": 800,
        "observed_share": 0.75,
        "appeared": None,
        "disappeared": None,
        "map_id": "lobby",
        "map_version": 1,
        "survey_id": survey_id,
        "device_id": None,
        "model": "spicd-net/1",
        "captured_at": "2026-03-01T12:00:00Z",
        "first_seen": "2026-03-01T12:00:00Z",
        "last_seen": "2026-03-01T12:00:00Z",
        "max_score": 0.93,
        "change_id": changed["properties"]["change_id"],
    }
    assert changed["properties"]["change_id"].startswith("change-")
    assert unobserved["properties"]["first_seen"] is None
    assert unobserved["properties"]["state"] == "unobserved"
    assert unobserved["properties"]["score"] is None


@pytest.mark.parametrize("what", ["tiles", "cloud.ply", "cloud.laz", "picture.png"])
@pytest.mark.parametrize("ended", [False, True])
def test_a_survey_without_a_result_says_so(
    client: TestClient, catalog: Catalog, what: str, ended: Any
) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    if ended:
        catalog.jobs.dismiss(job_id)
    answer = client.get(f"/surveys/{survey_id}/{what}")
    assert answer.status_code == 409
    assert job_id in answer.json()["detail"]


def test_the_files_of_a_survey_come_as_they_are(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog)
    missing = client.get(f"/surveys/{survey_id}/picture.png")
    assert missing.status_code == 404
    catalog.blobs.put_bytes(blob_keys.survey_cloud(survey_id), b"ply\n")
    catalog.blobs.put_bytes(blob_keys.survey_picture(survey_id), b"\x89PNG")
    catalog.blobs.put_bytes(blob_keys.survey_laz(survey_id), b"LASF")
    names = ("cloud.ply", "cloud.laz", "picture.png")
    cloud, packed, picture = (client.get(f"/surveys/{survey_id}/{name}") for name in names)
    assert (packed.content, packed.headers["content-type"]) == (b"LASF", "application/vnd.laszip")
    assert (cloud.content, cloud.headers["content-type"]) == (b"ply\n", "application/octet-stream")
    assert (picture.content, picture.headers["content-type"]) == (b"\x89PNG", "image/png")


def test_deleting_a_survey_stops_its_job_and_leaves_its_map(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    assert client.delete(f"/surveys/{survey_id}").status_code == 204
    assert queue.dismissed == [(job_id, "survey")]
    assert client.get(f"/surveys/{survey_id}").status_code == 404
    assert client.get("/maps/lobby").json()["status"] == "ready"


def refuse(catalog: Catalog, survey_id: str, job_id: str) -> None:
    """What the worker leaves of a survey of which no scan was accepted."""
    (scan,) = catalog.surveys.get(survey_id).scans
    why = {"accepted": False, "reason": "other_place", "detail": "hall.pcd: another place", "numbers": {}}
    placement = Placement(state="refused", confidence=None)
    catalog.surveys.save_outcomes(survey_id, [scan.model_copy(update=why)], placement=placement)
    catalog.blobs.put_bytes(blob_keys.survey_picture(survey_id), b"\x89PNG")
    catalog.jobs.fail(job_id, Problem(code="registration_failed", detail="hall.pcd: another place"))


def test_a_survey_shows_how_sure_its_placement_is(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, ready=False)
    assert client.get(f"/surveys/{survey_id}").json()["placement"] is None
    catalog.surveys.save_outcomes(survey_id, [], placement=Placement(state="in_doubt", confidence=0.71))
    expected = {"state": "in_doubt", "confidence": 0.71}
    assert client.get(f"/surveys/{survey_id}").json()["placement"] == expected
    (listed,) = client.get("/maps/lobby/surveys").json()["surveys"]
    assert listed["placement"] == expected


def test_a_refused_survey_shows_why_for_each_scan_and_has_a_picture(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    refuse(catalog, survey_id, job_id)
    found = client.get(f"/surveys/{survey_id}").json()
    assert found["placement"] == {"state": "refused", "confidence": None}
    (scan,) = found["scans"]
    assert (scan["reason"], scan["numbers"], scan["candidates"], scan["warnings"]) == (
        "other_place",
        {},
        None,
        [],
    )
    assert scan["detail"] in found["problem"]["detail"]
    (preview,) = (link for link in found["links"] if link["rel"] == "preview")
    assert client.get(preview["href"]).content == b"\x89PNG"
    assert client.get(f"/surveys/{survey_id}/tiles").status_code == 409


def test_a_survey_in_doubt_tells_no_objects_and_says_why(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    catalog.surveys.save_outcomes(survey_id, [], placement=Placement(state="in_doubt", confidence=0.71))
    tiles = [tile(0, 0, "inconsistent", 0.9, observed_share=1.0)]
    catalog.surveys.save_result(survey_id, tiles=tiles, threshold=0.5)
    catalog.jobs.succeed(job_id)
    answer = client.get(f"/surveys/{survey_id}/objects")
    assert (answer.status_code, "its placement is in doubt" in answer.json()["detail"]) == (404, True)
    assert client.get("/maps/lobby/changes").json()["features"] == []
    (feature,) = client.get(f"/surveys/{survey_id}/tiles").json()["features"]
    assert (feature["properties"]["state"], feature["properties"]["score"]) == ("inconsistent", 0.9)
    accepting = client.post("/maps/lobby/versions", json={"survey_id": survey_id})
    assert (accepting.status_code, accepting.json()["type"]) == (409, "urn:spicd:problem:conflict")
    assert "visit the place again" in accepting.json()["detail"]
