"""A model trained on a map by the steps of its job, in seconds, and a survey that names it."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.catalog.files import blob_keys
from service.catalog.jobs import Run
from service.catalog.records import JobRecord, ModelRecord
from service.catalog.sql.tables import now
from tests.support.house import MAP, MODEL, OTHER_CUT, House, run
from worker.detectors.card import Card
from worker.detectors.spicd_net.detector import SpicdNet
from worker.errors import DetectorUnavailable, TrainingFailed
from worker.jobs import site_training_set, training
from worker.jobs.models import kept_detector
from worker.jobs.step import Context
from worker.pipeline import archive
from worker.pipeline.registration.results import RegisteredScan
from worker.reporting import Reporter
from worker.training.dataset import TileSet, load_tiles
from worker.training.log import LOG

TINY = replace(training.SITE, batch=8, train_pairs=16, validation_pairs=8)


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SITE", TINY)


def asked(house: House, *, base: str | None = MODEL, epochs: int = 1) -> JobRecord:
    return house.catalog.models.create(MAP, base=base, epochs=epochs, minutes=5)[1]


def made(house: House, job: JobRecord) -> ModelRecord:
    return house.catalog.models.of_job(job.job_id)


def packed(house: House, job: JobRecord) -> TileSet:
    with house.catalog.blobs.local(blob_keys.model_tiles(job.job_id)) as path:
        return load_tiles(path)


def test_the_training_set_is_the_map_seen_by_the_halves_of_its_scans(house: House) -> None:
    job = asked(house)
    run(job, "pack")
    tiles = packed(house, job)
    key = blob_keys.map_reference(house.catalog.versions.ready(MAP, 1).job_id)
    with house.catalog.blobs.local(key) as path:
        of_map = archive.load_reference(path).tiles(min_points=512)
    assert tiles.centres == pytest.approx(of_map.grid.centers(of_map.indices))
    twice = [at for at, points in enumerate(tiles.points_b) if len(points)]
    assert 5 < len(twice) < len(tiles)
    for at, (a, b) in enumerate(zip(tiles.points_a, tiles.points_b, strict=True)):
        if at in twice:  # each half saw less than the whole map, and enough of the tile
            assert min(len(a), len(b)) >= 512
            assert len(a) < len(of_map.points[at])
        else:
            assert a == pytest.approx(of_map.points[at] - tiles.centres[at], abs=1e-3)


def test_halves_are_of_every_other_scan() -> None:
    scans = [
        RegisteredScan(
            name="",
            points=np.full((1, 3), number, np.float32),
            colors=None,
            map_from_scan=np.eye(4),
            sensor_origin=None,
        )
        for number in range(5)
    ]
    first, second = site_training_set.halves(scans, voxel_size=0.05)
    assert sorted(first[:, 0]) == [0, 2, 4]
    assert sorted(second[:, 0]) == [1, 3]


def strip(length: int, *, twice: int) -> TileSet:
    """Tiles in a row, 1.5 m each, of which two visits saw every so many."""
    point, nothing = np.zeros((1, 3), np.float32), np.empty((0, 3), np.float32)
    return TileSet(
        points_a=(point,) * length,
        points_b=tuple(point if number % twice == 0 else nothing for number in range(length)),
        observations=(),
        centres=np.c_[1.5 * np.arange(length), np.zeros((length, 2))],
        buildings=np.zeros(length, np.int32),
        tile_size=(1.5, 1.5, 1.0),
        source="a test",
    )


@pytest.mark.parametrize(
    ("tiles", "share"),
    [
        (strip(100, twice=1), 0.1),  # the paper's tenth
        (strip(20, twice=1), 0.2),  # of two tiles none is 3 m from the other; four will do
        (strip(100, twice=5), 0.2),  # of ten tiles two were seen twice, of twenty four
        (strip(8, twice=1), 0.4),
    ],
)
def test_a_tenth_is_held_out_or_the_least_that_is_enough(tiles: TileSet, share: float) -> None:
    assert site_training_set.held_out_share(tiles, min_separation=3.0) == share


@pytest.mark.parametrize("tiles", [strip(1, twice=1), strip(5, twice=1), strip(100, twice=50)])
def test_what_is_too_little_to_train_on_is_refused_with_its_numbers(tiles: TileSet) -> None:
    with pytest.raises(TrainingFailed, match=f"the map has {len(tiles)} tiles"):
        site_training_set.held_out_share(tiles, min_separation=3.0)


def test_a_model_is_trained_further_calibrated_and_named_by_a_survey(house: House) -> None:
    job = asked(house)
    run(job)
    model = made(house, job)
    assert house.catalog.jobs.get(job.job_id).status == "successful"
    assert (model.model, model.status, model.map_version) == ("lobby-net/1", "ready", 1)
    card = Card.model_validate(model.card)
    assert (card.name, card.version) == ("lobby-net", "1")
    assert card.detector_settings["patch_points"] == 512
    trained_on = card.training["settings"]["pairs"]["chamfer_points"]
    assert card.detector_settings["chamfer_points"] == trained_on == 128  # as the base, whose card names none
    assert (card.training["map_id"], card.training["base"]) == (MAP, MODEL)
    assert set(card.evaluation) == {"validation", MODEL, "pairs"}  # beside what it started from
    assert card.evaluation["validation"]["threshold"] == card.threshold
    assert not house.catalog.blobs.under(blob_keys.model_work(job.job_id))
    built_by = house.catalog.versions.ready(MAP, 1).job_id
    assert house.catalog.blobs.exists(blob_keys.map_embedding(built_by, "lobby-net/1", card.fingerprint))

    survey = house.survey_of(house.add("later.pcd", house.material.after), model="lobby-net/1")
    run(survey)
    found = house.survey(survey)
    assert (found.status, found.model, found.threshold) == ("ready", "lobby-net/1", card.threshold)
    assert any(tile["score"] is not None for tile in house.tiles(found.survey_id))


def test_the_weights_are_the_bases_or_near_them_and_those_that_the_card_vouches_for(house: House) -> None:
    job = asked(house)
    run(job)
    at = context(house, job)
    name = "head.classifier.0.weight"
    with kept_detector(at, "lobby-net/1") as ours, kept_detector(at, MODEL) as base:
        assert isinstance(ours, SpicdNet)
        assert isinstance(base, SpicdNet)
        apart = float((ours.weights()[name] - base.weights()[name]).abs().max())
    kept = "kept" in Card.model_validate(made(house, job).card).training
    assert apart == 0 if kept else 0 < apart < 0.1
    content = house.catalog.blobs.get_bytes(blob_keys.model_weights(job.job_id))
    assert hashlib.sha256(content).hexdigest() == Card.model_validate(made(house, job).card).sha256


def test_a_killed_training_goes_on_from_its_last_epoch(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    job = asked(house, base=None, epochs=2)
    run(job, "pack")

    class Killed(BaseException):
        """As a kill does, it leaves no time for anything."""

    real = training._keep

    def keep_and_die(at: Context, folder: Path) -> None:
        real(at, folder)
        raise Killed

    monkeypatch.setattr(training, "_keep", keep_and_die)
    with pytest.raises(Killed):
        run(job, "train")
    assert rows(house, job) == ["1"]
    monkeypatch.setattr(training, "_keep", real)
    run(job, "train")
    assert rows(house, job) == ["1", "2"]
    run(job, "finish")
    assert made(house, job).status == "ready"


def test_a_dismissed_training_stops_at_its_next_step_and_leaves_nothing(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = asked(house, epochs=50)
    run(job, "pack")
    epochs = []

    def dismiss(at: Context, folder: Path) -> None:
        epochs.append(folder)
        house.catalog.jobs.dismiss(job.job_id)

    monkeypatch.setattr(training, "_keep", dismiss)
    run(job, "train")
    assert len(epochs) == 1
    assert made(house, job).status == "failed"
    assert not house.catalog.blobs.under(blob_keys.model_folder(job.job_id))


def test_a_map_of_one_scan_is_too_little_and_says_so(house: House) -> None:
    only = house.add("only.pcd", house.material.after)
    run(house.map_of(only, map_id="attic"))
    job = house.catalog.models.create("attic", base=MODEL, minutes=1)[1]
    with pytest.raises(TrainingFailed, match=r"0 of them seen well by two"):
        run(job, "pack")
    found = house.catalog.jobs.get(job.job_id)
    assert (found.status, found.problem and found.problem.code) == ("failed", "training_failed")


def test_a_base_that_cuts_the_world_otherwise_is_refused(house: House) -> None:
    job = asked(house, base=OTHER_CUT)
    with pytest.raises(DetectorUnavailable, match="spicd-net/3 needs"):
        run(job, "pack")


def context(house: House, job: JobRecord) -> Context:
    return Context(
        settings=house.settings,
        catalog=house.catalog,
        job=job,
        run=Run(job_id=job.job_id, step="train", begun=now()),
        give_way=lambda: None,
        report=Reporter({}, lambda *_: True),
        scratch=house.folder,
    )


def rows(house: House, job: JobRecord) -> list[str]:
    """The epochs in the log that was kept."""
    text = house.catalog.blobs.get_bytes(blob_keys.model_checkpoint(job.job_id, LOG)).decode()
    return [line.split(",")[0] for line in text.splitlines()[1:]]
