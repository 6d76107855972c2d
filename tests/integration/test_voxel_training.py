"""The shipped voxel network trained further on a map by the steps of its job, and a survey that names the result."""

from __future__ import annotations

from dataclasses import replace

import pytest

from service.catalog.files import blob_keys
from service.catalog.records import JobRecord
from tests.support.house import SETTINGS, House, run
from worker.cloud import npz
from worker.detectors.card import MODEL_STORE, Card
from worker.errors import DetectorUnavailable
from worker.jobs import voxel_training
from worker.pipeline.alarms import AlarmCalibration
from worker.training.voxels.samples import SampleSet

MODEL, MAP = "voxel-net/1", "hall"


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxel_training, "SITE", replace(voxel_training.SITE, rounds=6, solids=6, quiet=0.0))
    training = voxel_training.TRAINING.with_values(steps=2, crops=2, held_out=2)
    monkeypatch.setattr(voxel_training, "TRAINING", training)


@pytest.fixture
def hall(house: House, monkeypatch: pytest.MonkeyPatch) -> House:
    """The same scans as a map of the shipped model."""
    monkeypatch.setenv("SPICD_MODEL_STORE", str(MODEL_STORE))
    scans = [house.add(f"hall-{number}.pcd", scan) for number, scan in enumerate(house.material.before)]
    ids = [scan.scan_id for scan in scans]
    job = house.catalog.maps.create(scan_ids=ids, model=MODEL, map_id=MAP, settings=SETTINGS)[1]
    run(job)
    return house


def asked(house: House, *, base: str | None = None) -> JobRecord:
    return house.catalog.models.create(MAP, base=base, epochs=2, minutes=5)[1]


def test_a_map_keeps_how_strong_a_change_has_to_be(hall: House) -> None:
    version = hall.catalog.versions.ready(MAP, 1)
    fingerprint = Card.model_validate_json((MODEL_STORE / MODEL / "card.json").read_bytes()).fingerprint
    with hall.catalog.blobs.local(blob_keys.map_alarms(version.job_id, MODEL, fingerprint)) as path:
        kept = npz.load(path, AlarmCalibration)
    assert (kept.surveys, kept.alarms_per_survey) == (2, 0.1)


def test_a_model_is_trained_further_and_scores_a_survey(hall: House) -> None:
    job = asked(hall)
    run(job)
    made = hall.catalog.models.of_job(job.job_id)
    assert made.status == "ready"
    card = Card.model_validate(made.card)
    assert (card.detector, card.training["base"]) == ("voxel-net", MODEL)
    assert card.evaluation["validation"]["kept"] in ("base", "trained")
    assert card.quiet is not None
    assert card.quiet.surveys >= 2
    survey = hall.add("hall-now.pcd", hall.material.after)
    asked_for = hall.catalog.surveys.create(MAP, scan_ids=[survey.scan_id], model=made.model, threshold=None)
    run(asked_for[1])
    assert hall.survey(asked_for[1]).status == "ready"
    assert not [key for key in hall.files() if "/work/" in key]


def test_every_step_may_run_twice(hall: House) -> None:
    job = asked(hall, base=MODEL)
    for step in ("pack", "pack", "train", "train"):
        run(job, step)
    with hall.catalog.blobs.local(blob_keys.model_tiles(job.job_id)) as path:
        samples = npz.load(path, SampleSet).samples
    assert len({sample.building for sample in samples}) > 1
    run(job, "finish")
    assert hall.catalog.models.of_job(job.job_id).status == "ready"


def test_a_rules_map_is_trained_for_by_the_shipped_network(hall: House) -> None:
    job = asked(hall)
    run(job, "pack", "train", "finish")
    with pytest.raises(DetectorUnavailable, match="no model"):
        run(asked(hall, base="voxel-net/77"), "pack")
