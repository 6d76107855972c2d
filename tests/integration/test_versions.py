"""Versions of a map: built by the steps of its job from the version before, with the real pipeline on a small room."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np
import pytest

from service.catalog.files import blob_keys
from service.catalog.records import JobRecord, ScanOutcome, ScanRecord, VersionRecord
from tests.support.house import MAP, House, run
from worker.cloud.formats.scan import read_scan
from worker.cloud.poses import difference
from worker.cloud.tiling import Tiles, tile_id
from worker.cloud.types import Indices, Points
from worker.jobs import versions
from worker.pipeline import archive
from worker.pipeline.flow import NoScanAccepted, build_map
from worker.pipeline.map_update import without
from worker.pipeline.registration.results import RegisteredScan


@pytest.fixture
def further(house: House) -> ScanRecord:
    """A scan that the map does not have: of the same room, by another visit."""
    return house.add("further.pcd", house.material.after)


def extend(house: House, *scans: ScanRecord) -> JobRecord:
    return house.catalog.versions.create(MAP, scan_ids=[scan.scan_id for scan in scans])[1]


def renew(house: House) -> tuple[JobRecord, str]:
    """Of the survey with threshold 0, to which every tile that it observed has changed."""
    survey_id = str(house.done[1].survey_id)
    return house.catalog.versions.create(MAP, survey_id=survey_id)[1], survey_id


def version(house: House, number: int) -> VersionRecord:
    return house.catalog.versions.ready(MAP, number)


def manifest(house: House, number: int) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(
        house.catalog.blobs.get_bytes(blob_keys.map_manifest(version(house, number).job_id))
    )
    return found


def counted(house: House, number: int) -> dict[str, int]:
    """Points of each tile of a version."""
    return {each["patch_id"]: each["n_original_points"] for each in manifest(house, number)["patches"]}


def tiles_of(house: House, job_id: str) -> Tiles:
    with house.catalog.blobs.local(blob_keys.map_reference(job_id)) as path:
        return archive.load_reference(path).tiles(min_points=512)


def scan_of(house: House, job_id: str, scan: ScanOutcome) -> RegisteredScan:
    with house.catalog.blobs.local(blob_keys.map_scan(job_id, scan.scan_id)) as path:
        return archive.load_scan(path)


def cloud(house: House, job_id: str) -> Points:
    with house.catalog.blobs.local(blob_keys.map_cloud(job_id)) as path:
        return read_scan(path).points


def changed(house: House, survey_id: str) -> Indices:
    found = house.tiles(survey_id)
    return np.array([tile["tile_index"] for tile in found if tile["state"] == "changed"], np.int32)


def test_the_first_version_tells_how_its_scans_were_registered(house: House) -> None:
    first = version(house, 1)
    assert first.registration is not None
    assert first.registration == house.catalog.maps.get(MAP).registration
    assert (first.registration["scans"], first.registration["accepted"]) == (2, 2)
    ids = [scan.scan_id for scan in first.scans]
    assert first.registration["reference"] in ids
    for scan in first.scans:
        assert scan.path is not None
        assert (scan.path[0], scan.path[-1]) == (first.registration["reference"], scan.scan_id)
        assert scan.translation_sigma is not None
        assert scan.rotation_sigma is not None
        assert 0 < scan.translation_sigma < 0.05
        assert 0 < scan.rotation_sigma < 0.02


def test_a_scan_of_a_survey_tells_how_sure_it_is_and_no_path(house: House) -> None:
    (scan,) = house.survey(house.done[0]).scans
    assert scan.path is None
    assert scan.translation_sigma is not None
    assert 0 < scan.translation_sigma < 0.05


def test_further_scans_make_a_version_that_keeps_the_base_as_it_was(
    house: House, further: ScanRecord
) -> None:
    before, files = version(house, 1), house.files()
    run(extend(house, further))
    first, second = version(house, 1), version(house, 2)
    assert house.catalog.maps.get(MAP).version == 2
    assert (second.base_version, second.survey_id) == (1, None)
    assert second.scans[:2] == first.scans == before.scans
    new = second.scans[2]
    assert (new.scan_id, new.accepted) == (further.scan_id, True)
    off, _ = difference(np.array(new.map_from_scan), house.material.after.world_from_sensor)
    assert off < 0.02
    assert (second.counts["scans"], second.counts["accepted"]) == (3, 3)
    assert {name: house.files()[name] for name in files} == files  # nothing of the old one was touched


def test_each_version_has_a_tileset_of_its_own_which_goes_with_it(house: House, further: ScanRecord) -> None:
    run(extend(house, further))
    first, second = version(house, 1), version(house, 2)
    for one in (first, second):
        contents = house.catalog.blobs.get_bytes(blob_keys.map_tileset_contents(one.job_id))
        assert one.tileset is not None
        assert one.tileset.n_points == one.counts["points"] == len(cloud(house, one.job_id))
        assert (one.tileset.bytes, one.tileset.sha256) == (
            len(contents),
            hashlib.sha256(contents).hexdigest(),
        )
        assert house.catalog.blobs.exists(blob_keys.map_tileset(one.job_id))
    assert first.tileset != second.tileset
    house.catalog.versions.delete(MAP, 1)
    assert not house.catalog.blobs.exists(blob_keys.map_tileset_contents(first.job_id))
    assert house.catalog.blobs.exists(blob_keys.map_tileset_contents(second.job_id))


def test_tiles_keep_their_ids_from_version_to_version(house: House, further: ScanRecord) -> None:
    run(extend(house, further))
    old, new = manifest(house, 1), manifest(house, 2)
    assert new["tile_origin"] == old["tile_origin"]
    centers = [{each["patch_id"]: each["tile_center"] for each in of["patches"]} for of in (old, new)]
    assert centers[0].items() <= centers[1].items()
    assert counted(house, 1) != counted(house, 2)


def test_a_survey_of_another_version_than_the_newest_is_compared_with_its_own(
    house: House, further: ScanRecord
) -> None:
    known = house.catalog.scans.get(house.survey(house.done[0]).scans[0].scan_id)
    early = house.survey_of(known)
    run(extend(house, further))
    late = house.survey_of(known)
    for job, number in ((early, 1), (late, 2)):
        run(job)
        survey = house.survey(job)
        assert (survey.map_version, survey.status) == (number, "ready")
        seen = {tile["tile_id"]: tile["n_reference"] for tile in house.tiles(survey.survey_id)}
        assert seen == counted(house, number)
    before = house.survey(house.done[0]).survey_id
    assert house.tiles(house.survey(early).survey_id) == house.tiles(before)


def test_a_version_stands_by_itself_when_the_one_before_is_deleted(house: House, further: ScanRecord) -> None:
    run(extend(house, further))
    gone = version(house, 1).job_id
    house.catalog.versions.delete(MAP, 1)
    assert house.catalog.blobs.under(blob_keys.map_folder(gone)) == []
    second = version(house, 2)
    assert all(len(scan_of(house, second.job_id, scan).points) > 0 for scan in second.scans)
    run(extend(house, house.add("again.pcd", house.material.before[0], seen_to=3.0)))
    assert version(house, 3).base_version == 2
    job = house.survey_of(house.catalog.scans.get(house.survey(house.done[0]).scans[0].scan_id))
    run(job)
    assert house.survey(job).status == "ready"


def test_a_survey_that_is_accepted_takes_the_place_of_the_map_where_it_found_it_changed(house: House) -> None:
    job, survey_id = renew(house)
    run(job)
    first, second = version(house, 1), version(house, 2)
    assert (second.base_version, second.survey_id) == (1, survey_id)
    assert second.scans == (*first.scans, *house.catalog.surveys.get(survey_id).scans)
    replaced, grid = changed(house, survey_id), tiles_of(house, first.job_id).grid
    assert len(replaced) > 2
    ids = {tile_id(index) for index in replaced}
    for scan in first.scans:
        whole, rest = (scan_of(house, each.job_id, scan) for each in (first, second))
        assert (grid.locate_among(rest.points, replaced) < 0).all()
        assert np.array_equal(rest.points, without(whole, grid, replaced).points)
        assert len(rest.points) < len(whole.points)
    seen = scan_of(house, second.job_id, second.scans[-1])
    points = cloud(house, second.job_id)
    new = points[grid.locate_among(points, replaced) >= 0]
    low, high = seen.points.min(axis=0), seen.points.max(axis=0)
    assert len(new) > 0
    assert ((new >= low - 1e-4) & (new <= high + 1e-4)).all()  # all of it was seen by the survey
    old, now = counted(house, 1), counted(house, 2)
    assert any(old[tile] != now[tile] for tile in ids & set(now))


@pytest.mark.parametrize("how", ["extend", "renew"])
def test_each_step_of_a_version_may_run_twice(house: House, further: ScanRecord, how: str) -> None:
    job = extend(house, further) if how == "extend" else renew(house)[0]
    run(job, "register")
    files, record = house.files(), house.catalog.versions.of_job(job.job_id)
    run(job, "register")
    assert house.files() == files
    again = house.catalog.versions.of_job(job.job_id)
    assert again.model_dump(exclude={"updated"}) == record.model_dump(exclude={"updated"})
    run(job, "encode")
    assert house.catalog.maps.get(MAP).version == 2


def test_a_version_of_a_foreign_scan_fails_lists_it_and_leaves_the_map_in_use(house: House) -> None:
    before = house.catalog.maps.get(MAP)
    job = extend(house, house.add("foreign.pcd", house.material.foreign, pose=False))
    with pytest.raises(NoScanAccepted):
        run(job)
    failed = house.catalog.versions.get(MAP, 2)
    assert failed.status == "failed"
    assert failed.problem is not None
    assert failed.problem.code == "registration_failed"
    assert failed.scans[:2] == before.scans
    assert failed.scans[2].accepted is False
    assert "foreign.pcd" in str(failed.scans[2].detail)
    assert house.catalog.maps.get(MAP) == before


def test_a_build_that_is_killed_goes_on_from_its_pairs_and_leaves_none_behind(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    remembered: list[int] = []
    real = build_map

    def build(files: Any, *, pairs: Any, **more: Any) -> Any:
        remembered.append(len(list(pairs.load())))
        return real(files, pairs=pairs, **more)

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("worker.jobs.pair_cache._INTERVAL_S", 0.0)
    monkeypatch.setattr(versions, "build_map", build)
    scans = [house.catalog.scans.get(scan.scan_id) for scan in version(house, 1).scans]
    job = house.map_of(*scans, map_id="again")
    with monkeypatch.context() as patch:
        patch.setattr(versions, "save_scans", killed)
        with pytest.raises(KeyboardInterrupt):
            run(job, "register")
    assert house.catalog.blobs.under(blob_keys.map_work(job.job_id)) != []
    run(job)
    assert remembered[0] == 0
    assert remembered[1] > 0
    assert house.catalog.blobs.under(blob_keys.map_work(job.job_id)) == []
    again, first = house.catalog.maps.get("again"), version(house, 1)
    assert again.scans == first.scans
    assert again.counts == first.counts
