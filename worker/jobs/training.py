"""The steps that train a model on a map: its tiles packed, the network trained, its threshold chosen."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from service.catalog import blob_keys
from service.catalog.records import ModelRecord, VersionRecord
from worker.detectors.card import Card, Preprocessing
from worker.detectors.detector import Detector
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.store import make_detector, resolve_device
from worker.errors import Cancelled, TrainingFailed
from worker.jobs.models import card_that_fits, kept_detector, pipeline_settings
from worker.jobs.scans import kept_scan
from worker.jobs.step import Context, put, step
from worker.jobs.tile_sets import halves, held_out_share, training_set
from worker.pipeline import archive
from worker.pipeline.registration.results import RegisteredScan
from worker.training.dataset import load_tiles, save_tiles
from worker.training.log import LOG
from worker.training.pairs import PairSettings
from worker.training.publish import publish
from worker.training.settings import TrainSettings
from worker.training.trainer import BEST, CHECKPOINT, train

#: An epoch is short, for a training goes on from the last one that is complete. Changes as in the shipped model.
SITE = TrainSettings(
    train_pairs=480, validation_pairs=160, patience=1000, pairs=PairSettings(density=(0.05, 0.30))
)
FURTHER = 1e-4  #: learning rate to begin with where another model is trained further
KEPT = (BEST, LOG, CHECKPOINT)  #: what a training goes on from, in the order it is written


@step
def pack_tiles(at: Context) -> None:
    """The map's tiles as a training set, each seen by one half of its scans and by the other."""
    model = at.catalog.models.of_job(at.job.job_id)
    version = at.catalog.versions.get(model.map_id, model.map_version)
    card = card_that_fits(at, model.base or version.model, version.model)
    settings = pipeline_settings(at, version, card)
    with at.catalog.blobs.local(blob_keys.map_tiles(version.job_id)) as path:
        tiles = archive.load_tiles(path)
    visits = halves(_scans(at, version), voxel_size=card.preprocessing.voxel_size)
    source = f"version {version.version} of map {version.map_id}, its scans parted in two"
    packed = training_set(tiles, visits, settings=settings.tiling, source=source)
    held_out_share(packed, min_separation=SITE.pairs.min_separation)  # fails here, before the wait
    put(at, blob_keys.model_tiles(at.job.job_id), lambda path: save_tiles(packed, path))


@step
def train_model(at: Context) -> None:
    """From nothing or from another model, for so many minutes; goes on from the last epoch that was kept."""
    model = at.catalog.models.of_job(at.job.job_id)
    folder, work = at.scratch / "run", blob_keys.model_work(at.job.job_id)
    _fetch(at, folder)
    try:
        with at.catalog.blobs.local(blob_keys.model_tiles(at.job.job_id)) as tiles:
            train(
                _settings(at, model, tiles),
                tiles,
                folder,
                lambda _, share: at.report("training", share),
                start=None if model.base is None else _spicd_net(at, model.base).weights(),
                on_epoch=functools.partial(_keep, at),
            )
    except FloatingPointError as error:
        at.catalog.blobs.delete_prefix(work)
        raise TrainingFailed(str(error)) from error
    except Cancelled:
        at.catalog.blobs.delete_prefix(work)
        raise


@step
def finish_model(at: Context) -> None:
    """Choose the threshold on held-out tiles, write the model and its card, and describe the map with it."""
    model = at.catalog.models.of_job(at.job.job_id)
    version = at.catalog.versions.get(model.map_id, model.map_version)
    folder, blobs = at.scratch / "run", at.catalog.blobs
    _fetch(at, folder)
    at.report("calibrating", 0.0)
    with blobs.local(blob_keys.model_tiles(at.job.job_id)) as tiles:
        made = _published(at, model, version, folder / BEST, tiles)
    card = Card.model_validate_json((made / "card.json").read_bytes()).model_copy(update={"licence": ""})
    weights = (made / str(card.weights)).read_bytes()
    blobs.put_bytes(blob_keys.model_weights(at.job.job_id), weights)
    blobs.put_file(blob_keys.model_log(at.job.job_id), folder / LOG)
    _describe(at, make_detector(card, weights, at.settings.device), model, version)
    at.catalog.models.save_card(at.job.job_id, card.model_dump(mode="json"))
    at.catalog.jobs.succeed(at.job.job_id)
    blobs.delete_prefix(blob_keys.model_work(at.job.job_id))


def _settings(at: Context, model: ModelRecord, tiles: Path) -> TrainSettings:
    version = at.catalog.versions.get(model.map_id, model.map_version)
    device = resolve_device(at.settings.device).type
    share = held_out_share(load_tiles(tiles), min_separation=SITE.pairs.min_separation)
    needs = _needs(at, model, version)
    return replace(
        SITE,
        epochs=model.epochs or SITE.epochs,
        minutes=model.minutes,
        held_out=share,
        start_from=model.base,
        learning_rate=SITE.learning_rate if model.base is None else FURTHER,
        device=device,
        coarse_search=device == "cpu",
        pairs=replace(
            SITE.pairs, patch_points=needs.patch_points, chamfer_points=needs.chamfer_points
        ),  # else the network would be used on another input than it was trained on
    )


def _published(at: Context, model: ModelRecord, version: VersionRecord, best: Path, tiles: Path) -> Path:
    """The folder of the model; beside its figures stand those of the model that it would replace.

    A base that ranks the held-out tiles no worse keeps its weights, and gets the threshold of this place.
    """
    other = model.base or version.model
    asked = {"base": model.base, "minutes": model.minutes, "epochs": model.epochs}
    about: dict[str, Any] = {"map_id": model.map_id, "map_version": model.map_version, "base": model.base}
    detector = kept_detector(at, other)
    return publish(
        best,
        tiles,
        at.scratch / "models",
        name=model.name,
        version=str(model.version),
        summary=f"SPICD-Net trained on version {model.map_version} of map {model.map_id}"
        + ("" if model.base is None else f", from {model.base}"),
        command=f"POST /maps/{model.map_id}/models {json.dumps(asked)}",
        about=about,
        beside={other: detector} if isinstance(detector, SpicdNet) else {},
        base=model.base,
        preprocessing=_needs(at, model, version),
    )


def _describe(at: Context, detector: Detector, model: ModelRecord, version: VersionRecord) -> None:
    """So that the first survey has half of the work, as with the map's own model."""
    with at.catalog.blobs.local(blob_keys.map_tiles(version.job_id)) as path:
        tiles = archive.load_tiles(path)
    description = detector.describe(tiles, progress=lambda _, share: at.report("encoding", share))
    key = blob_keys.map_embedding(version.job_id, model.model, detector.card.sha256)
    put(at, key, lambda path: archive.save_arrays(path, description))


def _needs(at: Context, model: ModelRecord, version: VersionRecord) -> Preprocessing:
    return card_that_fits(at, model.base or version.model, version.model).preprocessing


def _spicd_net(at: Context, model: str) -> SpicdNet:
    found = kept_detector(at, model)
    if not isinstance(found, SpicdNet):
        raise TrainingFailed(f"model {model} is no SPICD-Net, and only such a one can be trained further")
    return found


def _scans(at: Context, version: VersionRecord) -> Iterator[RegisteredScan]:
    accepted = [scan for scan in version.scans if scan.accepted]
    for done, scan in enumerate(accepted):
        at.report("packing", done / len(accepted))
        yield kept_scan(at, blob_keys.map_scan(version.job_id, scan.scan_id))


def _keep(at: Context, folder: Path) -> None:
    for name in KEPT:
        at.catalog.blobs.put_file(blob_keys.model_checkpoint(at.job.job_id, name), folder / name)


def _fetch(at: Context, folder: Path) -> None:
    """What an earlier attempt kept; copies, for a log is written to."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        key = blob_keys.model_checkpoint(at.job.job_id, name)
        if at.catalog.blobs.exists(key):
            with at.catalog.blobs.local(key) as path:
                shutil.copyfile(path, folder / name)
