"""The steps that train a model on a map: its tiles packed, the network trained, its threshold chosen."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from service.catalog.files import blob_keys
from service.catalog.records import ModelRecord, VersionRecord
from service.errors import NotFound
from worker.detectors.card import Card
from worker.detectors.registry import trainable_detectors
from worker.detectors.store import make_detector, read_card, resolve_device, settings_of, weights_of
from worker.errors import Cancelled, GaveWay, TrainingFailed
from worker.jobs import voxel_training
from worker.jobs.maps import encode_reference
from worker.jobs.models import card_that_fits, kept_detector, networks, pipeline_settings
from worker.jobs.scans import kept_scan
from worker.jobs.site_training_set import halves, held_out_share, training_set
from worker.jobs.step import Context, put, step
from worker.jobs.versions import kept_reference
from worker.jobs.voxel_training import VoxelTraining
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
def pack_tiles(context: Context) -> None:
    """Pack the map's tiles as a training set, each seen by one half of its scans and by the other."""
    asked = _asked(context)  # a base that cannot be trained, or too small a map, fails before the wait
    if asked.voxels is not None:
        asked.voxels.pack(context)
        return
    version, card = asked.version, asked.card
    settings = pipeline_settings(context, version, card)
    tiles = kept_reference(context, version).tiles(min_points=settings.tiling.min_points)
    visits = halves(_scans(context, version), voxel_size=card.preprocessing.voxel_size)
    source = f"version {version.version} of map {version.map_id}, its scans parted in two"
    packed = training_set(tiles, visits, settings=settings.tiling, source=source)
    held_out_share(packed, min_separation=SITE.pairs.min_separation)
    put(context, blob_keys.model_tiles(context.job.job_id), lambda path: save_tiles(packed, path))


@step
def train_model(context: Context) -> None:
    """Train from nothing or from another model, for so many minutes; go on from the last epoch that was kept."""
    asked = _asked(context)
    folder, work = context.scratch / "run", blob_keys.model_work(context.job.job_id)
    _fetch(context, folder)
    keep = functools.partial(_keep, context)
    try:
        if asked.voxels is not None:
            asked.voxels.train(context, folder, keep)
        else:
            _train_pairs(context, asked, folder, keep)
    except (FloatingPointError, ValueError) as error:  # no number, or files of an earlier release
        context.catalog.blobs.delete_prefix(work)
        raise TrainingFailed(str(error)) from error
    except GaveWay:
        raise
    except Cancelled:
        if _is_over(context):  # and does not go on in another run, which needs what this one kept
            context.catalog.blobs.delete_prefix(work)
        raise


def _is_over(context: Context) -> bool:
    """Tell whether the job was dismissed, or deleted."""
    with suppress(NotFound):
        return context.catalog.jobs.get(context.job.job_id).status == "dismissed"
    return True


def _train_pairs(context: Context, asked: _Asked, folder: Path, keep: Callable[[Path], None]) -> None:
    base = asked.model.base
    start = None
    if base is not None:
        with kept_detector(context, base) as detector:
            start = weights_of(detector)
    with context.catalog.blobs.local(blob_keys.model_tiles(context.job.job_id)) as tiles:
        train(
            _settings(context, asked, tiles),
            tiles,
            folder,
            lambda _, share: context.report("training", share),
            start=start,
            on_epoch=keep,
        )


@step
def finish_model(context: Context) -> None:
    """Choose the threshold on held-out tiles, write the model and its card, and encode the map with it."""
    asked = _asked(context)
    folder, blobs = context.scratch / "run", context.catalog.blobs
    _fetch(context, folder)
    context.report("calibrating", 0.0)
    try:
        card, weights, log = _finished(context, asked, folder)
    except ValueError as error:  # files of an earlier release
        raise TrainingFailed(str(error)) from error
    device, runtime = context.settings.device, networks(context.settings).runtime
    detector = make_detector(card, weights, device, runtime)
    if asked.voxels is not None:
        card = card.model_copy(update={"quiet": asked.voxels.quiet(context, card, detector)})
        detector = make_detector(card, weights, device, runtime)
    blobs.put_bytes(blob_keys.model_weights(context.job.job_id), weights)
    blobs.put_file(blob_keys.model_log(context.job.job_id), log)
    encode_reference(context, asked.version, detector, asked.model.model)
    context.catalog.models.save_card(context.job.job_id, card.model_dump(mode="json"))
    context.catalog.jobs.succeed(context.job.job_id, run=context.run)
    blobs.delete_prefix(blob_keys.model_work(context.job.job_id))


def _finished(context: Context, asked: _Asked, folder: Path) -> tuple[Card, bytes, Path]:
    """Return card and weights of the model, and the log of its training."""
    if asked.voxels is not None:
        return asked.voxels.finish(context, folder, _command(asked.model))
    with context.catalog.blobs.local(blob_keys.model_tiles(context.job.job_id)) as tiles:
        made = _published(context, asked, folder / BEST, tiles)
    card = read_card(made).model_copy(update={"licence": ""})
    return card, (made / str(card.weights)).read_bytes(), folder / LOG


@dataclass(frozen=True, kw_only=True, slots=True)
class _Asked:
    """What is to be trained."""

    model: ModelRecord
    version: VersionRecord  #: of the map, that it is trained on
    card: Card  #: of the model that is trained further, or of the one that the map was built for
    detector: str  #: key of what is trained

    @property
    def voxels(self) -> VoxelTraining | None:
        """The training of a model that scores voxels; None of one that compares tiles by their points."""
        if self.detector != voxel_training.DETECTOR:
            return None
        return VoxelTraining(model=self.model, version=self.version, card=self.card)


def _asked(context: Context) -> _Asked:
    """Look up what the job asks for. Raises DetectorUnavailable, and TrainingFailed for a base that has no network."""
    model = context.catalog.models.of_job(context.job.job_id)
    version = context.catalog.versions.get(model.map_id, model.map_version)
    card = card_that_fits(context, model.base or version.model, version.model)
    detector = _detector_key(model, card)
    if detector == voxel_training.DETECTOR != card.detector:
        card = card_that_fits(context, voxel_training.SHIPPED, version.model)
    return _Asked(model=model, version=version, card=card, detector=detector)


def _detector_key(model: ModelRecord, card: Card) -> str:
    """Return the detector that is trained: the card's, or where that cannot be and no base is asked for, the default.

    Raises TrainingFailed.
    """
    trainable = [*trainable_detectors(), voxel_training.DETECTOR]
    if card.detector in trainable:
        return card.detector
    if model.base is None:
        return voxel_training.DETECTOR if card.preprocessing.tiles == "touched" else SITE.detector
    raise TrainingFailed(
        f"model {model.base} cannot be trained further: nothing of a detector {card.detector!r} is trained; "
        f"name a base of {' or '.join(trainable)}, or none"
    )


def _settings(context: Context, asked: _Asked, tiles: Path) -> TrainSettings:
    model, card = asked.model, asked.card
    device = resolve_device(context.settings.device).type
    share = held_out_share(load_tiles(tiles), min_separation=SITE.pairs.min_separation)
    # else the network would be used on another input than it was trained on
    own = settings_of(card) if asked.detector == card.detector else {}
    pairs = {name: own[name] for name in ("patch_points", "chamfer_points", "counts") if name in own}
    return replace(
        SITE,
        detector=asked.detector,
        seed=own.get("seed", SITE.seed),
        epochs=model.epochs or SITE.epochs,
        minutes=model.minutes,
        held_out=share,
        start_from=model.base,
        learning_rate=SITE.learning_rate if model.base is None else FURTHER,
        device=device,
        coarse_search=device == "cpu",
        pairs=replace(SITE.pairs, **pairs),
    )


def _published(context: Context, asked: _Asked, best: Path, tiles: Path) -> Path:
    """Return the folder of the model; beside its figures stand those of the model that it would replace.

    A base that ranks the held-out tiles no worse keeps its weights, and gets the threshold of this place.
    """
    model = asked.model
    other = model.base or asked.version.model
    title = replace(SITE, detector=asked.detector).network.title
    with kept_detector(context, other) as detector:
        return publish(
            best,
            tiles,
            context.scratch / "models",
            name=model.name,
            version=str(model.version),
            summary=f"{title} trained on version {model.map_version} of map {model.map_id}"
            + ("" if model.base is None else f", from {model.base}"),
            command=_command(model),
            about={"map_id": model.map_id, "map_version": model.map_version, "base": model.base},
            beside={other: detector},
            base=model.base,
            preprocessing=asked.card.preprocessing,
        )


def _command(model: ModelRecord) -> str:
    wanted = {"base": model.base, "minutes": model.minutes, "epochs": model.epochs}
    return f"POST /maps/{model.map_id}/models {json.dumps(wanted)}"


def _scans(context: Context, version: VersionRecord) -> Iterator[RegisteredScan]:
    accepted = [scan for scan in version.scans if scan.accepted]
    for done, scan in enumerate(accepted):
        context.report("packing", done / len(accepted))
        yield kept_scan(context, blob_keys.map_scan(version.job_id, scan.scan_id))


def _keep(context: Context, folder: Path) -> None:
    for name in (*(name for name in KEPT if (folder / name).exists()), *voxel_training.kept_files(folder)):
        context.catalog.blobs.put_file(blob_keys.model_checkpoint(context.job.job_id, name), folder / name)
    context.give_way()


def _fetch(context: Context, folder: Path) -> None:
    """Copy what an earlier attempt kept; a link would not do, for a log is written to."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*KEPT, *voxel_training.FILES):
        key = blob_keys.model_checkpoint(context.job.job_id, name)
        if context.catalog.blobs.exists(key):
            with context.catalog.blobs.local(key) as path:
                shutil.copyfile(path, folder / name)
