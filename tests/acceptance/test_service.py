"""The whole service as its clients meet it: real processes, HTTP, scans in and changes out.

Nothing here rests on what the network knows: every claim holds for any weights.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples import client as example
from service.client import Client
from tests.support.running_service import Service, TwoHosts
from tests.support.two_visits import Visits
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import difference

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")

MODEL = "voxel-net/1"
STATES = ("unchanged", "changed", "inconsistent", "unobserved")


@pytest.fixture(scope="module")
def room(service: Service, visits: Visits) -> dict[str, Any]:
    """The map `room`, built of scans sent both ways."""
    (path, pose), *others = visits.first
    form = service.http.post("/scans", files={"file": (path.name, path.read_bytes())}, data={"pose": pose})
    assert form.status_code == 201, form.text
    ids = [form.json()["scan_id"], *(service.upload(other, pose=pose) for other, pose in others)]
    job = service.succeeded(service.post("/maps", id="room", scan_ids=ids)["job_id"])
    assert (job["processID"], job["map_id"], job["survey_id"]) == ("map", "room", None)
    built: dict[str, Any] = service.get("/maps/room")
    return built


@pytest.fixture(scope="module")
def survey(service: Service, visits: Visits, room: dict[str, Any]) -> dict[str, Any]:
    """The second visit, which saw only one half of the room."""
    path, pose = visits.second
    scan = service.upload(path, pose=pose, captured_at="2026-03-01T12:00:00Z", device_id="robot-1")
    accepted = service.post("/maps/room/surveys", scan_ids=[scan])
    service.succeeded(accepted["job_id"])
    found: dict[str, Any] = service.get(f"/surveys/{accepted['survey_id']}")
    return found


@pytest.fixture(scope="module")
def tiles(service: Service, survey: dict[str, Any]) -> list[dict[str, Any]]:
    """The properties of every tile."""
    collection = service.get(f"/surveys/{survey['survey_id']}/tiles")
    return [feature["properties"] for feature in collection["features"]]


def test_a_map_is_built_in_the_frame_of_the_pose_priors(room: dict[str, Any], visits: Visits) -> None:
    """Of all of them together: no single scan stands exactly where its prior has it, and none far from it."""
    assert room["status"] == "ready"
    placed = [
        (scan["map_from_scan"], json.loads(prior))
        for scan, (_, prior) in zip(room["scans"], visits.first, strict=True)
        if scan["accepted"]
    ]
    assert room["counts"]["accepted"] == len(placed) >= 3
    off = np.array([np.subtract(pose, prior)[:3, 3] for pose, prior in placed])
    assert np.linalg.norm(off, axis=1).max() < 0.3
    assert np.abs(off.mean(axis=0)).max() < 0.05
    assert room["bounds"]["min"][2] == pytest.approx(0.0, abs=0.2)  # the floor


def test_every_scan_left_out_of_a_map_has_its_reason(room: dict[str, Any]) -> None:
    assert all((scan["reason"] is None) == scan["accepted"] for scan in room["scans"])


def test_the_manifest_lists_the_tiles_that_surveys_answer_for(
    service: Service, room: dict[str, Any], tiles: list[dict[str, Any]]
) -> None:
    manifest = service.get("/maps/room/manifest")
    assert manifest["n_valid_patches"] == len(manifest["patches"]) == room["counts"]["tiles"]
    assert {each["patch_id"] for each in manifest["patches"]} == {tile["tile_id"] for tile in tiles}
    assert all(each["n_original_points"] >= manifest["min_points"] for each in manifest["patches"])


def test_a_survey_is_placed_where_it_was_taken(survey: dict[str, Any], visits: Visits) -> None:
    placed = survey["scans"][0]
    assert placed["accepted"]
    off, turned = difference(
        np.array(placed["map_from_scan"]), np.array(json.loads(visits.second[1]))
    )  # the prior, itself off by some centimetres
    assert off < 0.25
    assert np.degrees(turned) < 5


def test_counts_by_state_add_up_to_the_tiles(survey: dict[str, Any], tiles: list[dict[str, Any]]) -> None:
    counts = Counter(tile["state"] for tile in tiles)
    assert survey["counts"] == {"tiles": len(tiles), **{state: counts[state] for state in STATES}}


def test_what_nobody_saw_is_unobserved_and_has_no_score(tiles: list[dict[str, Any]], visits: Visits) -> None:
    beyond = [tile for tile in tiles if tile["center"][0] - 0.75 > visits.seen_to + 0.1]
    assert beyond
    assert {tile["n_current"] for tile in beyond} == {0}
    assert {tile["state"] for tile in beyond} == {"unobserved"}
    assert all((tile["score"] is None) <= (tile["state"] == "unobserved") for tile in tiles)
    assert all((tile["score"] is None) <= (tile["observed_share"] == 0) for tile in tiles)
    assert any(tile["state"] != "unobserved" for tile in tiles)


def test_a_tile_is_changed_only_above_the_threshold_and_where_an_object_lies(
    service: Service, survey: dict[str, Any], tiles: list[dict[str, Any]]
) -> None:
    things = service.get(f"/surveys/{survey['survey_id']}/objects")["features"]
    places = [thing["properties"][side] for thing in things for side in ("now", "before")]
    touched = {tile for place in places if place for tile in place["tiles"]}
    assert survey["model"] == MODEL
    for tile in tiles:
        if tile["state"] != "unobserved":
            assert sum(tile["probabilities"]) == pytest.approx(1, abs=1e-4)
            assert tile["score"] == pytest.approx(1 - tile["probabilities"][0], abs=1e-6)
            above = tile["score"] > survey["threshold"]
            assert (tile["state"] == "changed") == (above and tile["tile_id"] in touched)


def test_features_are_prisms_around_their_centres(service: Service, survey: dict[str, Any]) -> None:
    collection = service.get(f"/surveys/{survey['survey_id']}/tiles?profile=jsonfg")
    assert collection["type"] == "FeatureCollection"
    assert collection["numberMatched"] == collection["numberReturned"] == len(collection["features"])
    assert len({feature["id"] for feature in collection["features"]}) == len(collection["features"])
    for feature in collection["features"]:
        place, about = feature["place"], feature["properties"]
        ring = np.array(place["base"]["coordinates"][0])
        np.testing.assert_allclose(ring[0], ring[-1])
        np.testing.assert_allclose(np.ptp(ring, axis=0), (1.5, 1.5))
        np.testing.assert_allclose(
            [*(ring[:4].mean(axis=0)), (place["lower"] + place["upper"]) / 2], about["center"], atol=1e-6
        )
        assert feature["geometry"] is None
        assert feature["time"] == {"timestamp": "2026-03-01T12:00:00Z"}
        assert (about["map_id"], about["survey_id"]) == ("room", survey["survey_id"])


def test_a_lower_threshold_asked_for_is_the_one_used_and_changes_are_the_changed_tiles(
    service: Service, visits: Visits, survey: dict[str, Any]
) -> None:
    accepted = service.post("/maps/room/surveys", scan_ids=[survey["scans"][0]["scan_id"]], threshold=0.0)
    service.succeeded(accepted["job_id"])
    again = service.get(f"/surveys/{accepted['survey_id']}")
    assert again["threshold"] == 0.0
    assert again["counts"]["changed"] == again["counts"]["tiles"] - again["counts"]["unobserved"] > 0
    page = service.get(f"/maps/room/changes?survey={again['survey_id']}&limit=1000")
    assert page["numberMatched"] == len(page["features"]) == again["counts"]["changed"]
    scores = [feature["properties"]["score"] for feature in page["features"]]
    assert scores == sorted(scores, reverse=True)
    everything = service.get("/maps/room/changes?limit=1000&repeats=true")
    assert everything["numberMatched"] == again["counts"]["changed"] + survey["counts"]["changed"]
    once = service.get("/maps/room/changes?limit=1000")
    assert once["numberMatched"] == again["counts"]["changed"]  # the same visit: its tiles are among them
    half = service.get(
        f"/maps/room/changes?survey={again['survey_id']}&bbox={visits.seen_to + 0.2},-50,50,50"
    )
    assert all(
        feature["properties"]["center"][0] + 0.75 > visits.seen_to + 0.2 for feature in half["features"]
    )
    assert half["numberMatched"] < page["numberMatched"]


def test_the_cloud_is_a_sound_scan_with_a_score_and_a_state_at_every_point(
    service: Service, survey: dict[str, Any], visits: Visits, tmp_path: Path
) -> None:
    content = service.http.get(f"/surveys/{survey['survey_id']}/cloud.ply").content
    header = content[: content.index(b"end_header")]
    assert b"property float scalar_change_score" in header
    assert b"property uchar scalar_tile_state" in header
    path = tmp_path / "cloud.ply"
    path.write_bytes(content)
    cloud = read_scan(path)
    assert cloud.colors is not None
    assert len(cloud.points) > 5_000
    assert cloud.points[:, 0].max() < visits.seen_to + 0.3


def test_the_map_has_a_cloud_and_the_survey_a_picture(service: Service, survey: dict[str, Any]) -> None:
    assert service.http.get("/maps/room/cloud.ply").content.startswith(b"ply\n")
    picture = service.http.get(f"/surveys/{survey['survey_id']}/picture.png")
    assert picture.headers["Content-Type"] == "image/png"
    assert picture.content.startswith(b"\x89PNG\r\n\x1a\n")
    width, height = (int.from_bytes(picture.content[at : at + 4]) for at in (16, 20))
    assert min(width, height) > 300


def test_the_example_of_the_client_prints_the_changed_tiles(
    service: Service, visits: Visits, capsys: pytest.CaptureFixture[str]
) -> None:
    (before, _), (after, _), *_ = visits.first
    with Client(service.url) as client:
        example.main(client, before, after)
        (surveyed,) = (job for job in client.jobs()[:1])
        changes = client.changes(surveyed["map_id"])["features"]
    printed = capsys.readouterr().out.splitlines()
    assert [line for line in printed if line.startswith("100 ")]
    tiles = [feature["properties"]["tile_id"] for feature in changes]
    assert [line.split()[0] for line in printed if line.startswith("tile_")] == tiles


def test_a_survey_of_a_foreign_place_fails_with_its_numbers(
    service: Service, room: dict[str, Any], visits: Visits
) -> None:
    if isinstance(service, TwoHosts):
        pytest.skip("searched for at length on one host")
    accepted = service.post("/maps/room/surveys", visits.foreign)
    job = service.ended(accepted["job_id"])
    assert (job["status"], job["problem"]["type"]) == ("failed", "urn:spicd:problem:registration_failed")
    survey = service.get(f"/surveys/{accepted['survey_id']}")
    assert survey["status"] == "failed"
    assert not survey["scans"][0]["accepted"]
    (scan,) = survey["scans"]
    assert f"{scan['detail']} [{scan['reason']}]" in job["problem"]["detail"]
    assert survey["placement"] == {"state": "refused", "confidence": None}
    assert service.http.get(f"/surveys/{accepted['survey_id']}/picture.png").content.startswith(b"\x89PNG")
    assert service.http.get(f"/surveys/{accepted['survey_id']}/tiles").status_code == 409


def test_a_survey_with_a_broken_file_fails_and_names_the_file(
    service: Service, room: dict[str, Any], visits: Visits, tmp_path: Path
) -> None:
    broken = tmp_path / "cut-short.pcd"
    broken.write_bytes(visits.second[0].read_bytes()[:50_000])
    job = service.ended(service.post("/maps/room/surveys", broken)["job_id"])
    assert (job["status"], job["problem"]["type"]) == ("failed", "urn:spicd:problem:scan_unreadable")
    assert job["problem"]["detail"].startswith("cut-short.pcd: ")


def _transform(path: Path) -> np.ndarray:
    return np.loadtxt([line for line in path.read_text().splitlines() if not line.startswith("#")])


@pytest.mark.parametrize(
    ("before", "after", "truth"),
    [
        ("room_scan/room_scan1.pcd", "room_scan/room_scan2.pcd", "room_scan/T_scan2_to_scan1.txt"),
        (
            "ipad_rooms/pix4d_database_808_db.ply",
            "ipad_rooms/pix4d_user_808_user.ply",
            "ipad_rooms/T_user_to_db_808.txt",
        ),
    ],
)
def test_real_scans_without_a_pose_are_found_within_3_cm_and_half_a_degree(
    service: Service, shared_data: Path, before: str, after: str, truth: str
) -> None:
    if type(service) is not Service:
        pytest.skip("where the files are kept has no say in this")
    built = service.post("/maps", shared_data / before)
    service.succeeded(built["job_id"])
    accepted = service.post(f"/maps/{built['map_id']}/surveys", shared_data / after)
    service.succeeded(accepted["job_id"])
    survey = service.get(f"/surveys/{accepted['survey_id']}")
    off, turned = difference(np.array(survey["scans"][0]["map_from_scan"]), _transform(shared_data / truth))
    assert off < 0.03
    assert np.degrees(turned) < 0.5
    assert survey["counts"]["tiles"] - survey["counts"]["unobserved"] > 0
    assert service.http.get(f"/surveys/{accepted['survey_id']}/cloud.ply").content.startswith(b"ply\n")
    assert service.http.get(f"/surveys/{accepted['survey_id']}/picture.png").status_code == 200


def test_a_deleted_map_is_gone_with_its_surveys(
    service: Service, room: dict[str, Any], survey: dict[str, Any]
) -> None:
    assert service.http.delete("/maps/room").status_code == 204
    gone = [f"/maps/room{rest}" for rest in ("", "/manifest", "/changes", "/cloud.ply")]
    for path in (*gone, f"/surveys/{survey['survey_id']}", f"/jobs/{room['job_id']}"):
        answer = service.http.get(path)
        assert (answer.status_code, answer.json()["type"]) == (404, "urn:spicd:problem:not_found")


def test_asked_to_end_the_service_leaves_no_process(service: Service) -> None:
    processes = service.processes()
    assert len(processes) >= service.least
    service.end()
    assert service.process.returncode == 0
    left = [pid for pid in processes if Path(f"/proc/{pid}/cmdline").exists()]
    assert left == []
