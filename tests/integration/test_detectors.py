"""Detectors beside SPICD-Net go through map, survey and results by their card and their entry alone."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from service.catalog.files import blob_keys
from service.catalog.records import JobRecord
from tests.support import toy
from tests.support.house import MAP, House, run
from tests.support.release_0_1 import current_of_0_1, reference_of_0_1, scan_of_0_1, tiles_of_0_1
from worker.cloud import npz
from worker.detectors.card import MODEL_STORE
from worker.detectors.detector import Detection
from worker.errors import MapFailed, TrainingFailed
from worker.pipeline import archive
from worker.pipeline.mapping.fusion import CurrentMap


@pytest.fixture
def stocked(house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> House:
    """The house with the toy and C2C in its model store."""
    models = tmp_path / "models"
    shutil.copytree(house.material.model_store, models)
    shutil.copytree(MODEL_STORE / "c2c", models / "c2c")
    toy.install(monkeypatch, models)
    monkeypatch.setenv("SPICD_MODEL_STORE", str(models))
    return house


def mapped(house: House, model: str) -> JobRecord:
    scans = house.catalog.maps.get(MAP).scans
    ids = [scan.scan_id for scan in scans]
    job = house.catalog.maps.create(scan_ids=ids, model=model, map_id="hall", settings={})[1]
    run(job)
    return job


def surveyed(house: House, model: str, *, map_id: str) -> JobRecord:
    scan = house.survey(house.done[0]).scans[0]
    job = house.catalog.surveys.create(map_id, scan_ids=[scan.scan_id], model=model)[1]
    run(job)
    return job


@pytest.mark.parametrize("model", [toy.MODEL, "c2c/1"])
def test_a_map_is_built_for_another_detector_and_its_survey_has_results(stocked: House, model: str) -> None:
    built = mapped(stocked, model)
    listing = json.loads(stocked.catalog.blobs.get_bytes(blob_keys.map_manifest(built.job_id)))
    assert listing["patch_size"] is None
    survey = stocked.survey(surveyed(stocked, model, map_id="hall"))
    assert (survey.status, survey.model) == ("ready", model)
    tiles = stocked.tiles(survey.survey_id)
    assert len(tiles) == survey.counts["tiles"] == listing["n_valid_patches"]
    assert {tile["state"] for tile in tiles} >= {"unchanged", "unobserved"}
    assert survey.threshold is not None
    for tile in tiles:
        assert (tile["score"] is None) == (tile["state"] == "unobserved")
        assert (tile["state"] == "changed") == ((tile["score"] or 0) > survey.threshold)
    blobs = stocked.catalog.blobs
    assert blobs.get_bytes(blob_keys.survey_picture(survey.survey_id)).startswith(b"\x89PNG")


def test_what_a_detector_says_of_voxels_is_kept_and_it_may_load_every_scan(stocked: House) -> None:
    mapped(stocked, toy.MODEL)
    survey = stocked.survey(surveyed(stocked, toy.MODEL, map_id="hall"))
    with stocked.catalog.blobs.local(blob_keys.survey_scores(survey.survey_id)) as path:
        voxels = npz.load(path, Detection).voxels
    assert voxels is not None
    assert voxels.keys.tolist() == [3, 5]


def test_another_detector_scores_a_map_that_was_built_for_spicd_net(stocked: House) -> None:
    survey = stocked.survey(surveyed(stocked, "c2c/1", map_id=MAP))
    assert survey.status == "ready"
    assert survey.threshold == 0.5
    assert survey.counts["unobserved"] < survey.counts["tiles"]


def test_what_has_no_network_cannot_be_trained_further_and_says_so(stocked: House) -> None:
    job = stocked.catalog.models.create(MAP, base="c2c/1", minutes=1)[1]
    with pytest.raises(
        TrainingFailed, match=r"model c2c/1 cannot be trained further.* name a base of .*spicd-net"
    ):
        run(job, "pack")
    problem = stocked.catalog.jobs.get(job.job_id).problem
    assert problem is not None
    assert problem.code == "training_failed"


def as_0_1_left_it(house: House) -> None:
    """Put the files of the map and of its first survey back as release 0.1 wrote them."""
    blobs, version = house.catalog.blobs, house.catalog.versions.ready(MAP, 1)
    old = house.folder / "old.npz"
    with blobs.local(blob_keys.map_reference(version.job_id)) as path:
        reference = archive.load_reference(path)
    reference_of_0_1(old, reference)
    blobs.put_file(blob_keys.map_reference(version.job_id), old)
    tiles_of_0_1(old, reference.tiles(min_points=512))
    blobs.put_file(blob_keys.map_tiles(version.job_id), old)
    scans = [blob_keys.map_scan(version.job_id, scan.scan_id) for scan in version.scans]
    for job in house.done:
        survey = house.survey(job)
        scans += [blob_keys.survey_scan(survey.survey_id, scan.scan_id) for scan in survey.scans]
        with blobs.local(blob_keys.survey_current(survey.survey_id)) as path:
            current_of_0_1(old, npz.load(path, CurrentMap))
        blobs.put_file(blob_keys.survey_current(survey.survey_id), old)
    for key in scans:
        with blobs.local(key) as path:
            scan_of_0_1(old, archive.load_scan(path))
        blobs.put_file(key, old)


def test_a_survey_of_a_map_that_release_0_1_built_says_what_it_said_then(house: House) -> None:
    before = house.tiles(house.survey(house.done[0]).survey_id)
    as_0_1_left_it(house)
    survey = house.survey(surveyed(house, "spicd-net/1", map_id=MAP))
    assert survey.status == "ready"
    assert house.tiles(survey.survey_id) == before


def test_a_map_in_files_that_nobody_knows_is_refused_with_what_to_do(house: House) -> None:
    key = blob_keys.map_reference(house.catalog.versions.ready(MAP, 1).job_id)
    unknown = house.folder / "unknown.npz"
    npz.save_arrays(unknown, {"octree": np.zeros(3)})
    house.catalog.blobs.put_file(key, unknown)
    with pytest.raises(MapFailed, match="build the map anew from its scans"):
        surveyed(house, "spicd-net/1", map_id=MAP)
    problem = house.catalog.jobs.page(limit=1).items[0].problem
    assert problem is not None
    assert problem.code == "map_failed"


def test_a_survey_that_release_0_1_had_registered_is_scored_and_exported(house: House) -> None:
    before = house.tiles(house.survey(house.done[0]).survey_id)
    scan = house.survey(house.done[0]).scans[0]
    job = house.survey_of(house.catalog.scans.get(scan.scan_id))
    run(job, "register")
    as_0_1_left_it(house)
    survey_id, blobs = house.survey(job).survey_id, house.catalog.blobs
    with blobs.local(blob_keys.survey_current(survey_id)) as path:
        current_of_0_1(house.folder / "old.npz", npz.load(path, CurrentMap))
    blobs.put_file(blob_keys.survey_current(survey_id), house.folder / "old.npz")
    blobs.put_bytes(f"{blob_keys.survey_folder(survey_id)}pairs.npz", b"nobody reads it")
    run(job, "score", "export")
    assert house.survey(job).status == "ready"
    assert house.tiles(survey_id) == before


@pytest.mark.parametrize("how", ["extend", "renew"])
def test_a_map_that_release_0_1_built_goes_on_and_its_next_version_needs_no_old_file(
    house: House, how: str
) -> None:
    grid = _grid(house, 1)
    as_0_1_left_it(house)
    if how == "renew":
        job = house.catalog.versions.create(MAP, survey_id=str(house.done[1].survey_id))[1]
    else:
        further = house.add("further.pcd", house.material.after)
        job = house.catalog.versions.create(MAP, scan_ids=[further.scan_id])[1]
    run(job)
    assert not house.catalog.blobs.exists(blob_keys.map_tiles(job.job_id))
    assert _grid(house, 2) == grid


def _grid(house: House, number: int) -> list[float]:
    with house.catalog.blobs.local(
        blob_keys.map_reference(house.catalog.versions.ready(MAP, number).job_id)
    ) as path:
        grid = archive.load_reference(path).grid
    return np.concatenate([grid.origin, grid.size]).tolist()
