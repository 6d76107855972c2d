"""Objects from scans to the catalog: what a detector of voxels finds of a crate that somebody put into the room."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest

from service.catalog.files import blob_keys
from service.catalog.findings.changes import ChangeFilter
from service.catalog.findings.objects import SightingFilter
from service.catalog.jobs import Jobs
from service.catalog.records import JobRecord, ObjectRecord, Placement, ScanRecord, SurveyRecord
from service.errors import Conflict
from tests.support.house import MAP, House, run
from tests.support.release_0_1 import scan_of_0_1
from tests.support.traffic import Room, Upload
from tests.support.two_visits import free_place
from worker.cloud import npz
from worker.cloud.seen import Seen
from worker.detectors.card import MODEL_STORE
from worker.errors import MapFailed
from worker.pipeline import archive
from worker.pipeline.flow import LocatedSurvey, locate_survey
from worker.pipeline.registration.results import SurveyPlacement
from worker.pipeline.results.export import PointKind
from worker.simulation.scenes import Change, random_room
from worker.simulation.scenes.furniture import crate
from worker.simulation.visits import visit

RULE = "voxel-rule/1"


@dataclass(frozen=True)
class Crate:
    """A crate that was put into the room, and a visit that saw it."""

    change: Change
    scan: ScanRecord

    def is_told_by(self, thing: ObjectRecord) -> bool:
        assert self.change.after is not None
        if thing.now is None:
            return False
        return bool(np.linalg.norm(np.subtract(thing.now.center, self.change.after.mean(axis=0))) < 0.4)


@pytest.fixture
def seeing(house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> House:
    """The house with the voxel rule in its model store; its map was built for SPICD-Net."""
    models = tmp_path / "models"
    shutil.copytree(house.material.model_store, models)
    shutil.copytree(MODEL_STORE / "voxel-rule", models / "voxel-rule")
    monkeypatch.setenv("SPICD_MODEL_STORE", str(models))
    return house


@pytest.fixture
def put(seeing: House) -> Crate:
    """The room of the house, 1.2 m or more from where the map's first scan was taken."""
    pose = seeing.material.before[0].world_from_sensor
    room = random_room(3)
    x, y = free_place(room, around=(float(pose[0, 3]), float(pose[1, 3])))
    later, change = room.with_added("crate", crate(0.7, 0.5, 0.6).at(x, y))
    return Crate(change=change, scan=seeing.add("crate.pcd", visit(later, (pose,), seed=9)[0]))


def compared(house: House, *scans: ScanRecord, model: str = RULE, map_id: str = MAP) -> SurveyRecord:
    ids = [scan.scan_id for scan in scans]
    job = house.catalog.surveys.create(map_id, scan_ids=ids, model=model)[1]
    run(job)
    return house.survey(job)


def sent(house: House, upload: Upload) -> str:
    pose = np.array(json.loads(upload.pose))
    return house.add_file(upload.name, upload.content, pose=pose).scan_id


def things(house: House, survey: SurveyRecord) -> list[ObjectRecord]:
    page = house.catalog.objects.of_survey(SightingFilter(survey_id=survey.survey_id))
    return [sighting.thing for sighting in page.items]


def seen_by_the_map(house: House, job: JobRecord | None = None) -> Seen:
    job_id = house.catalog.versions.ready(MAP, 1).job_id if job is None else job.job_id
    with house.catalog.blobs.local(blob_keys.map_seen(job_id)) as path:
        return npz.load(path, Seen)


def test_a_crate_is_told_as_an_object_of_a_map_that_was_built_for_another_model(
    seeing: House, put: Crate
) -> None:
    survey = compared(seeing, put.scan)
    assert survey.status == "ready"
    found = things(seeing, survey)
    (told,) = (thing for thing in found if put.is_told_by(thing))
    assert (told.kind, told.number) == ("appeared", 1)
    assert told.now is not None
    assert put.change.after is not None
    assert told.now.size[2] == pytest.approx(put.change.after[1, 2], abs=0.15)
    assert told.scans_seen_through >= 1
    assert survey.objects is not None
    assert survey.objects["appeared"] >= 1
    assert sum(survey.objects.values()) == len(found)
    assert survey.moving == 0


def test_tiles_of_voxels_tell_their_share_and_their_counts(seeing: House, put: Crate) -> None:
    survey = compared(seeing, put.scan)
    tiles = {tile["tile_id"]: tile for tile in seeing.tiles(survey.survey_id)}
    assert all(0 <= tile["observed_share"] <= 1 for tile in tiles.values())
    assert any(tile["state"] == "unobserved" and tile["score"] is not None for tile in tiles.values())
    told = things(seeing, survey)[0]
    assert told.now is not None
    assert {tiles[tile_id]["state"] for tile_id in told.now.tiles} >= {"changed"}
    assert sum(tiles[tile_id]["appeared"] for tile_id in told.now.tiles) >= told.now.voxels


def test_the_cloud_bears_the_number_of_each_object(seeing: House, put: Crate) -> None:
    survey = compared(seeing, put.scan)
    with seeing.catalog.blobs.local(blob_keys.survey_cloud(survey.survey_id)) as path:
        cloud = o3d.t.io.read_point_cloud(path).point
    numbers, kinds = (cloud[f"scalar_{name}"].numpy().ravel() for name in ("object_id", "kind"))
    for thing in things(seeing, survey):
        for place, kind in ((thing.now, PointKind.APPEARED), (thing.before, PointKind.DISAPPEARED)):
            if place is not None:
                assert ((numbers == thing.number) & (kinds == kind)).sum() == place.voxels


def test_a_survey_of_the_visit_that_made_the_map_finds_nothing(seeing: House) -> None:
    scans = [seeing.catalog.scans.get(scan.scan_id) for scan in seeing.catalog.maps.get(MAP).scans]
    survey = compared(seeing, *scans)
    assert things(seeing, survey) == []
    assert survey.objects == {"appeared": 0, "disappeared": 0, "moved": 0}
    assert survey.counts["changed"] == 0


def test_a_map_of_voxels_lists_all_tiles_with_a_point_and_is_scored_by_either_model(
    seeing: House, put: Crate
) -> None:
    ids = [scan.scan_id for scan in seeing.catalog.maps.get(MAP).scans]
    job = seeing.catalog.maps.create(scan_ids=ids, model=RULE, map_id="hall", settings={})[1]
    run(job)
    listing = json.loads(seeing.catalog.blobs.get_bytes(blob_keys.map_manifest(job.job_id)))
    counts = seeing.catalog.maps.ready("hall").counts
    assert listing["min_points"] == 1
    assert listing["n_valid_patches"] == counts["tiles"] > seeing.catalog.maps.ready(MAP).counts["tiles"]
    assert sum(patch["n_original_points"] for patch in listing["patches"]) == counts["points"]
    by_voxels = compared(seeing, put.scan, map_id="hall")
    by_points = compared(seeing, put.scan, model="spicd-net/1", map_id="hall")
    assert any(put.is_told_by(thing) for thing in things(seeing, by_voxels))
    assert by_points.objects is None
    assert by_points.counts["tiles"] < counts["tiles"] <= by_voxels.counts["tiles"]


def test_a_survey_whose_placement_is_in_doubt_tells_neither_tiles_nor_objects(
    seeing: House, put: Crate, monkeypatch: pytest.MonkeyPatch
) -> None:
    def doubting(*given: Any, **named: Any) -> LocatedSurvey:
        found = locate_survey(*given, **named)
        return replace(found, placement=SurveyPlacement(confidence=0.71, in_doubt=True))

    sure = compared(seeing, put.scan)
    assert sure.placement is not None
    assert sure.placement.state == "confirmed"
    monkeypatch.setattr("worker.jobs.surveys.locate_survey", doubting)
    survey = compared(seeing, put.scan)
    assert survey.status == "ready"
    assert survey.placement == Placement(state="in_doubt", confidence=0.71)
    assert (survey.objects, survey.moving) == (None, None)
    assert survey.counts["unchanged"] == survey.counts["changed"] == 0
    assert survey.counts["inconsistent"] > 0 < survey.counts["unobserved"]
    assert survey.counts["unobserved"] == sure.counts["unobserved"]
    told = seeing.catalog.changes.page(ChangeFilter(map_id=MAP, repeats=True), limit=1000).items
    assert survey.survey_id not in {change.survey_id for change in told}
    assert sure.survey_id in {change.survey_id for change in told}
    assert seeing.catalog.blobs.exists(blob_keys.survey_picture(survey.survey_id))
    assert seeing.catalog.blobs.exists(blob_keys.survey_cloud(survey.survey_id))
    with pytest.raises(Conflict, match="in doubt"):
        seeing.catalog.versions.create(MAP, survey_id=survey.survey_id)


def test_what_a_map_saw_is_made_on_first_use_where_release_0_1_kept_nothing_of_it(
    seeing: House, put: Crate
) -> None:
    before, blobs = seen_by_the_map(seeing), seeing.catalog.blobs
    _as_0_1_left_it(seeing)
    assert not blobs.exists(blob_keys.map_seen(seeing.catalog.versions.ready(MAP, 1).job_id))
    survey = compared(seeing, put.scan)
    assert any(put.is_told_by(thing) for thing in things(seeing, survey))
    made = seen_by_the_map(seeing)
    assert np.array_equal(made.keys, before.keys)
    assert np.array_equal(made.hits, before.hits)
    assert made.sights is not None
    assert before.sights is not None
    assert np.array_equal(made.sights.nearest, before.sights.nearest)


def test_a_map_whose_scans_are_gone_is_refused_with_what_to_do_and_other_models_go_on(
    seeing: House, put: Crate
) -> None:
    version = seeing.catalog.versions.ready(MAP, 1)
    _as_0_1_left_it(seeing)
    seeing.catalog.blobs.delete_prefix(f"{blob_keys.map_folder(version.job_id)}scans/")
    with pytest.raises(
        MapFailed, match="build the map anew from its scans, or ask for a model that compares"
    ):
        compared(seeing, put.scan)
    assert compared(seeing, put.scan, model="spicd-net/1").status == "ready"


def test_what_a_survey_saw_is_made_where_it_was_registered_by_release_0_1(seeing: House, put: Crate) -> None:
    job = seeing.catalog.surveys.create(MAP, scan_ids=[put.scan.scan_id], model=RULE)[1]
    run(job, "register")
    survey_id = seeing.survey(job).survey_id
    key = blob_keys.survey_seen(survey_id)
    path = seeing.catalog.blobs.path(key)
    assert path is not None
    before = path.read_bytes()
    path.unlink()
    run(job, "score", "export")
    assert any(put.is_told_by(thing) for thing in things(seeing, seeing.survey(job)))
    assert path.read_bytes() == before


def test_the_steps_may_run_twice_and_leave_the_same(seeing: House, put: Crate) -> None:
    job = seeing.catalog.surveys.create(MAP, scan_ids=[put.scan.scan_id], model=RULE)[1]
    for step in ("register", "score"):
        run(job, step)
        files = seeing.files()
        run(job, step)
        assert seeing.files() == files


def test_a_last_step_that_was_killed_after_it_recorded_its_findings_tells_the_same_again(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between `save_result` and `succeed`; in this survey a tile scores above the threshold, but no object lies there."""
    monkeypatch.setenv("SPICD_MODEL_STORE", str(MODEL_STORE))
    room = Room(map_scans=2, views=2, scan_s=1.0)
    before, visits = room.map_uploads(), room.survey_upload(1)
    ids = [sent(house, upload) for upload in before]
    run(house.catalog.maps.create(scan_ids=ids, model="voxel-net/1", map_id="room", settings={})[1])
    job = house.catalog.surveys.create("room", scan_ids=[sent(house, visits)], model="voxel-net/1")[1]
    with monkeypatch.context() as patch:
        patch.setattr(Jobs, "succeed", lambda *_, **__: False)
        run(job)
    recorded = house.tiles(house.survey(job).survey_id)
    assert any((tile["score"] or 0) > 0.5 and tile["state"] == "unchanged" for tile in recorded)
    run(job, "export")
    assert house.catalog.jobs.get(job.job_id).status == "successful"
    assert house.tiles(house.survey(job).survey_id) == recorded
    assert house.survey(job).asked_threshold is None


def test_an_extended_map_saw_what_both_saw_and_a_renewed_one_has_the_crate(seeing: House, put: Crate) -> None:
    first = seen_by_the_map(seeing)
    survey = compared(seeing, put.scan)
    further = seeing.add("further.pcd", seeing.material.after)
    job = seeing.catalog.versions.create(MAP, scan_ids=[further.scan_id])[1]
    run(job)
    grown = seen_by_the_map(seeing, job)
    assert first.sights is not None
    assert grown.sights is not None
    assert len(grown.sights) == len(first.sights) + 1
    assert grown.hits.sum() > first.hits.sum()
    again = compared(seeing, put.scan)
    assert any(put.is_told_by(thing) for thing in things(seeing, again))
    job = seeing.catalog.versions.create(MAP, survey_id=again.survey_id)[1]
    run(job)
    renewed = compared(seeing, put.scan)
    assert survey.map_version < again.map_version < renewed.map_version
    assert not any(put.is_told_by(thing) for thing in things(seeing, renewed))


def test_when_the_crate_is_taken_out_of_a_renewed_map_it_has_disappeared(seeing: House, put: Crate) -> None:
    """The map's older scans saw through the crate's place, which must not make it look like something that walked."""
    taken_over = compared(seeing, put.scan)
    run(seeing.catalog.versions.create(MAP, survey_id=taken_over.survey_id)[1])
    empty = seeing.add("empty.pcd", replace(seeing.material.before[0], points=_again(seeing)))
    survey = compared(seeing, empty)
    assert put.change.after is not None
    gone = [thing.before for thing in things(seeing, survey) if thing.before is not None]
    middle = put.change.after.mean(axis=0)
    assert min(np.linalg.norm(np.subtract(place.center, middle)) for place in gone) < 0.4


def test_files_of_what_was_seen_go_with_the_survey_and_the_map(seeing: House, put: Crate) -> None:
    survey = compared(seeing, put.scan)
    job_id = seeing.catalog.versions.ready(MAP, 1).job_id
    seeing.catalog.surveys.delete(survey.survey_id)
    assert seeing.catalog.blobs.under(blob_keys.survey_folder(survey.survey_id)) == []
    seeing.catalog.maps.delete(MAP)
    assert seeing.catalog.blobs.under(blob_keys.map_folder(job_id)) == []


def _again(house: House) -> np.ndarray:
    """Another scan of the unchanged room from the place of the map's first, sensor frame."""
    pose = house.material.before[0].world_from_sensor
    return visit(random_room(3), (pose,), seed=12)[0].points


def _as_0_1_left_it(house: House) -> None:
    """Take away what later releases keep of the map's scans, and put the scans back as release 0.1 wrote them."""
    blobs, version = house.catalog.blobs, house.catalog.versions.ready(MAP, 1)
    path = blobs.path(blob_keys.map_seen(version.job_id))
    assert path is not None
    path.unlink()
    for scan in version.scans:
        key = blob_keys.map_scan(version.job_id, scan.scan_id)
        with blobs.local(key) as kept:
            scan_of_0_1(house.folder / "old.npz", archive.load_scan(kept))
        blobs.put_file(key, house.folder / "old.npz")
