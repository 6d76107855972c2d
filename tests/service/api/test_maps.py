"""/maps: recorded with their job, or not at all."""

from __future__ import annotations

import json
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.settings import Settings
from tests.support.samples import (
    BOUNDS,
    IDENTITY,
    MODEL,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    ply,
    tile,
)
from worker.pipeline.settings import PipelineSettings


def test_how_far_the_carrier_is_looked_for_can_be_set(client: TestClient, catalog: Catalog) -> None:
    scan = add_scan(catalog)
    asked = {"id": "lobby", "scan_ids": [scan.scan_id], "settings": {"carrier": {"radius": 0}}}
    assert client.post("/maps", json=asked).status_code == 202
    settings = client.get("/maps/lobby").json()["settings"]
    assert settings["carrier"] == {"radius": 0}
    assert PipelineSettings.model_validate(settings).carrier.radius == 0
    wrong = client.post("/maps", json={**asked, "id": "hall", "settings": {"carrier": {"radius": -1}}})
    assert (wrong.status_code, "carrier.radius" in wrong.text) == (422, True)


def test_a_map_of_known_scans_is_accepted_and_its_job_submitted(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    scan = add_scan(catalog)
    asked = {
        "id": "lobby",
        "name": "Lobby",
        "scan_ids": [scan.scan_id],
        "settings": {"registration": {"min_fitness": 0.6}},
    }
    answer = client.post("/maps", json=asked)
    assert answer.status_code == 202
    job_id = answer.json()["job_id"]
    assert answer.headers["location"] == f"/jobs/{job_id}"
    assert queue.submitted == [(job_id, "register")]
    found = client.get("/maps/lobby").json()
    assert (found["status"], found["name"], found["model"]) == ("building", "Lobby", MODEL)
    assert (found["version"], found["registration"], found["anchor"]) == (1, None, None)
    assert found["settings"] == {"registration": {"min_fitness": 0.6}, "alarms_per_survey": 0.1}
    assert found["scans"] == [
        {
            "scan_id": scan.scan_id,
            "pose": None,
            "accepted": None,
            "fitness": None,
            "rmse": None,
            "map_from_scan": None,
            "translation_sigma": None,
            "rotation_sigma": None,
            "path": None,
            "confidence": None,
            "reason": None,
            "detail": None,
            "numbers": None,
            "candidates": None,
            "warnings": [],
        }
    ]
    assert client.get(answer.headers["location"]).json()["map_id"] == "lobby"


def test_what_becomes_of_a_survey_in_doubt_or_off_in_scale_is_a_setting_of_the_map(
    client: TestClient, catalog: Catalog
) -> None:
    scan = add_scan(catalog)
    asked = {"min_confidence": 0.9, "scale": "refuse"}
    body = {"id": "hall", "scan_ids": [scan.scan_id], "settings": {"placement": asked}}
    assert client.post("/maps", json=body).status_code == 202
    assert client.get("/maps/hall").json()["settings"]["placement"] == asked
    kept = PipelineSettings.model_validate({"placement": asked}).placement
    assert (kept.min_confidence, kept.scale) == (0.9, "refuse")


@pytest.mark.parametrize("placement", [{"min_confidence": 1}, {"scale": "mend"}, {"scales": "warn"}])
def test_an_unknown_setting_of_the_placement_is_refused(
    client: TestClient, catalog: Catalog, placement: dict[str, object]
) -> None:
    scan = add_scan(catalog)
    body = {"scan_ids": [scan.scan_id], "settings": {"placement": placement}}
    answer = client.post("/maps", json=body)
    assert answer.status_code == 422
    assert "placement" in answer.text


def test_a_map_of_files_keeps_them_as_scans_in_their_order(client: TestClient, catalog: Catalog) -> None:
    known = add_scan(catalog, "known")
    files = [("scans", (f"{name}.ply", ply(name))) for name in ("b", "a", "b")]
    form = {"id": "hall", "scan_ids": known.scan_id, "device_id": "robot-7", "settings": "{}"}
    answer = client.post("/maps", data=form, files=files)
    assert answer.status_code == 202
    scans = [catalog.scans.get(scan.scan_id) for scan in catalog.maps.get("hall").scans]
    assert [scan.filename for scan in scans] == ["known.ply", "b.ply", "a.ply"]
    assert [scan.device_id for scan in scans] == [None, "robot-7", "robot-7"]


@pytest.mark.parametrize("given", [["a", "b"], "a,b", '["a", "b"]'])
def test_a_form_names_scans_in_three_ways(client: TestClient, catalog: Catalog, given: Any) -> None:
    ids = {name: add_scan(catalog, name).scan_id for name in ("a", "b")}
    if isinstance(given, list):
        given = [ids[name] for name in given]
    else:
        given = given.replace("a", ids["a"], 1) if given == "a,b" else json.dumps(list(ids.values()))
        given = given if given.startswith("[") else ",".join(ids.values())
    answer = client.post(
        "/maps", data={"id": "hall", "scan_ids": given}, files={"scans": ("c.ply", ply("c"))}
    )
    assert answer.status_code == 202
    assert [scan.scan_id for scan in catalog.maps.get("hall").scans][:2] == list(ids.values())


def test_without_an_id_the_service_chooses_one(client: TestClient, catalog: Catalog) -> None:
    scan_ids = [add_scan(catalog).scan_id]
    ids = {client.post("/maps", json={"scan_ids": scan_ids}).json()["map_id"] for _ in range(2)}
    assert len(ids) == 2
    assert all(client.get(f"/maps/{map_id}").status_code == 200 for map_id in ids)


def test_when_the_queue_is_down_nothing_stays_recorded(
    client: TestClient, catalog: Catalog, queue: RememberingQueue, settings: Settings
) -> None:
    queue.down = True
    answer = client.post("/maps", data={"id": "lobby"}, files={"scans": ("a.ply", ply())})
    assert answer.status_code == 503
    assert answer.json()["type"] == "urn:spicd:problem:queue_unavailable"
    assert catalog.maps.page().items == []
    assert catalog.jobs.page().items == []
    assert catalog.scans.page().items == []
    assert [path for path in settings.data_dir.rglob("*.ply") if path.is_file()] == []
    queue.down = False
    again = client.post("/maps", data={"id": "lobby"}, files={"scans": ("a.ply", ply())})
    assert again.status_code == 202


def test_a_taken_id_keeps_no_new_file_and_leaves_the_known_ones(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    known = add_scan(catalog, "known")
    answer = client.post(
        "/maps",
        data={"id": "lobby"},
        files=[("scans", ("new.ply", ply("new"))), ("scans", ("known.ply", ply("known")))],
    )
    assert answer.status_code == 409
    names = {scan.filename for scan in catalog.scans.page().items}
    assert known.filename in names
    assert "new.ply" not in names


def test_a_ready_map_shows_what_it_is_and_its_files(client: TestClient, catalog: Catalog) -> None:
    job_id = add_map(catalog)
    catalog.blobs.put_bytes(blob_keys.map_manifest(job_id), b'{"n_valid_patches": 4}')
    catalog.blobs.put_bytes(blob_keys.map_cloud(job_id), b"ply\n0123456789")
    found = client.get("/maps/lobby").json()
    assert (found["status"], found["counts"]) == ("ready", {"tiles": 4})
    assert (found["version"], found["registration"]) == (1, {"scans": 1})
    assert found["bounds"] == {"min": [0, 0, 0], "max": [3, 3, 1]}
    assert found["scans"][0]["map_from_scan"][3] == [0, 0, 0, 1]
    hrefs = {link["rel"]: link["href"] for link in found["links"]}
    assert client.get(hrefs["manifest"]).json() == {"n_valid_patches": 4}
    catalog.blobs.put_bytes(blob_keys.map_laz(job_id), b"LASF")
    assert client.get(hrefs["cloud-laz"]).content == b"LASF"
    cloud = client.get(hrefs["cloud"])
    assert cloud.content == b"ply\n0123456789"
    part = client.get(hrefs["cloud"], headers={"Range": "bytes=4-6"})
    assert (part.status_code, part.content) == (206, b"012")


def test_deleting_a_map_stops_its_jobs_first(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    assert client.delete("/maps/lobby").status_code == 204
    assert queue.dismissed == [(job_id, "survey")]
    for path in ("/maps/lobby", f"/surveys/{survey_id}", f"/jobs/{job_id}"):
        assert client.get(path).status_code == 404


def test_a_map_can_be_deleted_while_the_queue_is_down(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog, ready=False)
    queue.down = True
    assert client.delete("/maps/lobby").status_code == 204
    assert client.get("/maps/lobby").status_code == 404


def test_lists_are_short_and_the_thing_itself_tells_of_its_scans(
    client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    survey_id, _ = add_survey(catalog, [tile(0, 0)])
    for path, name, itself in (
        ("/maps", "maps", "/maps/lobby"),
        ("/maps/lobby/versions", "versions", "/maps/lobby/versions/1"),
        ("/maps/lobby/surveys", "surveys", f"/surveys/{survey_id}"),
    ):
        (listed,) = client.get(path).json()[name]
        whole = client.get(itself).json()
        assert set(whole) - set(listed) <= {"scans", "settings", "registration"}
        assert "scans" in set(whole) - set(listed)
        assert {member: whole[member] for member in listed} == listed
        assert listed["scan_count"] == len(whole["scans"]) == 1


def test_a_list_of_maps_does_not_grow_with_their_scans(client: TestClient, catalog: Catalog) -> None:
    sizes = []
    for name, count in (("few", 1), ("many", 60)):
        ids = [add_scan(catalog, f"{name}-{number}").scan_id for number in range(count)]
        catalog.maps.create(scan_ids=ids, model=MODEL, map_id=name)
        sizes.append(len(str(client.get("/maps?limit=1").json()["maps"][0])))
    assert sizes[1] < sizes[0] + 50


def test_a_map_does_not_grow_with_its_scans_beyond_the_first_hundred(
    client: TestClient, catalog: Catalog
) -> None:
    ids = [add_scan(catalog, f"scan-{number}").scan_id for number in range(102)]
    poses = {ids[101]: IDENTITY}
    catalog.maps.create(scan_ids=ids, poses=poses, model=MODEL, map_id="hall")
    for path in ("/maps/hall", "/maps/hall/versions/1"):
        found = client.get(path).json()
        assert (len(found["scans"]), found["scan_count"]) == (100, 102)
        (every,) = [link["href"] for link in found["links"] if link["rel"] == "scans"]
        assert every == f"{path}/scans"
        first = client.get(every).json()
        assert (first["version"], first["scans"]) == (1, found["scans"])
        last = client.get(following(first)).json()
        assert [scan["scan_id"] for scan in last["scans"]] == ids[100:]
        assert last["scans"][1]["pose"] == [list(row) for row in IDENTITY]
        assert following(last) == ""


def test_a_list_of_scans_goes_on_in_the_version_that_it_began_in(
    client: TestClient, catalog: Catalog
) -> None:
    first = add_scan(catalog, "first").scan_id
    _, job = catalog.maps.create(
        scan_ids=[first, add_scan(catalog, "second").scan_id], model=MODEL, map_id="hall"
    )
    finish(catalog, job.job_id)
    page = client.get("/maps/hall/scans?limit=1").json()
    _, job = catalog.versions.create("hall", scan_ids=[add_scan(catalog, "third").scan_id])
    finish(catalog, job.job_id)
    going_on = client.get(following(page)).json()
    assert (going_on["version"], len(going_on["scans"]), following(going_on)) == (1, 1, "")
    newer = client.get("/maps/hall/scans").json()
    assert (newer["version"], len(newer["scans"])) == (2, 3)
    other = following(page).replace("/maps/hall/", "/maps/hall/versions/2/")
    refused = client.get(other)
    assert (refused.status_code, refused.json()["type"]) == (422, "urn:spicd:problem:bad_request")
    assert client.delete("/maps/hall/versions/1").status_code == 204
    assert client.get(following(page)).status_code == 410
    assert client.get("/maps/nowhere/scans").status_code == 404


def following(page: Any) -> str:
    """Where a page says that its list goes on; nothing where it ends."""
    return "".join(link["href"] for link in page["links"] if link["rel"] == "next")


def finish(catalog: Catalog, job_id: str) -> None:
    """Have every scan of a version accepted, and the version in use."""
    told = {"accepted": True, "map_from_scan": IDENTITY}
    outcomes = [scan.model_copy(update=told) for scan in catalog.versions.of_job(job_id).scans]
    catalog.versions.save_result(job_id, outcomes=outcomes, bounds=BOUNDS, counts={"tiles": 4})
    catalog.jobs.succeed(job_id)
