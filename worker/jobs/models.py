"""The model of a job, of the release or the site's own: kept open between jobs, and held against the map."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.records import ModelRecord, VersionRecord
from service.settings import Settings
from worker.detectors.card import Card
from worker.detectors.detector import Detector
from worker.detectors.precision import PrecisionChoice, chosen_precision
from worker.detectors.running.calls import DirectBatches, FittedRuns, limit_gpu_memory
from worker.detectors.running.meter import Meter
from worker.detectors.running.runtime import Runtime
from worker.detectors.running.shared import SharedBatches
from worker.detectors.running.warm import WarmModels
from worker.detectors.store import make_detector, open_card, open_detector, resolve_device
from worker.errors import DetectorUnavailable
from worker.jobs.step import Context
from worker.pipeline.settings import PipelineSettings

ON_GPU = 4  #: steps at a time where nothing is set: one computes, one or two prepare, one writes


@dataclass(frozen=True, kw_only=True, slots=True)
class Networks:
    """What all steps of an inference worker's process share."""

    concurrency: int  #: steps at a time
    runtime: Runtime
    warm: WarmModels
    meter: Meter

    def tells(self) -> dict[str, int]:
        """Return what stands beside the worker's signs of life (`service.queue.WarmModels`)."""
        held = self.warm.held
        return {"models": held.models, "model_bytes": held.bytes}


def networks(settings: Settings) -> Networks:
    """Return what the steps of this process share; made once."""
    return _networks(
        settings.inference_concurrency or (ON_GPU if runs_on_gpu(settings) else 1),
        settings.inference_batch_tiles,
        settings.inference_batch_wait_ms / 1000,
        settings.inference_precision,
        settings.inference_model_bytes,
    )


@functools.lru_cache(maxsize=1)
def _networks(
    concurrency: int, tiles: int, wait_s: float, precision: PrecisionChoice, model_bytes: int
) -> Networks:
    meter = Meter()
    fitted = FittedRuns(tiles, meter)
    batches = SharedBatches(fitted, wait_s=wait_s) if concurrency > 1 else DirectBatches(fitted)
    return Networks(
        concurrency=concurrency,
        runtime=Runtime(batches=batches, precision=precision),
        warm=WarmModels(model_bytes, meter),
        meter=meter,
    )


def finds_gpu() -> bool:
    """Tell whether torch finds the GPU that `cuda` asks for."""
    try:
        resolve_device("cuda")
    except DetectorUnavailable:
        return False
    return True


def runs_on_gpu(settings: Settings) -> bool:
    """Tell whether networks of this process run on a GPU."""
    return settings.device != "cpu" and finds_gpu()


def take_gpu_share(settings: Settings) -> bool:
    """Take no more than this worker's share of the GPU's memory from now on; tell whether there is a GPU to share."""
    if not runs_on_gpu(settings):
        return False
    limit_gpu_memory(settings.inference_gpu_share, settings.inference_workers)
    return True


def lacks_precision(settings: Settings) -> bool:
    """Tell whether the device does not have the precision that is asked for."""
    try:
        chosen_precision(settings.inference_precision, resolve_device(settings.device), holds=True)
    except DetectorUnavailable:
        return True
    return False


@contextmanager
def kept_detector(context: Context, model: str) -> Iterator[Detector]:
    """Give a model for the length of a block; its process keeps it open for other steps. Raises DetectorUnavailable."""
    shared = networks(context.settings)
    key, opened = _opening(context, model)
    with shared.warm.borrow(key, opened) as detector, shared.runtime.batches.expect(detector.card.model):
        yield detector


def _opening(context: Context, model: str) -> tuple[Hashable, Callable[[], Detector]]:
    """Return what a model is kept under, and what opens it."""
    own, settings = _own(context, model), context.settings
    runtime = networks(settings).runtime
    if own is None:
        store, device = settings.model_store, settings.device
        return (store, model, device), lambda: open_detector(store, model, device, runtime)
    card = Card.model_validate(own.card)
    url, job_id = (
        settings.resolved_blob_url(),
        own.job_id,
    )  # by its job: a name may come again once its map is deleted
    key = (url, job_id, card.model_dump_json(), settings.device)
    return key, lambda: make_detector(card, _own_weights(url, job_id), settings.device, runtime)


def card_of(context: Context, model: str) -> Card:
    """Return the card of `name/version`. Raises DetectorUnavailable."""
    own = _own(context, model)
    return open_card(context.settings.model_store, model) if own is None else Card.model_validate(own.card)


def card_that_fits(context: Context, model: str, map_model: str) -> Card:
    """Return the model's card; to score a map it must cut the world as the map was cut. Raises DetectorUnavailable.

    Which tiles are scored, and how dense they have to be, is the model's own affair.
    """
    card, built_with = (card_of(context, name) for name in (model, map_model))
    ours, theirs = card.preprocessing, built_with.preprocessing
    if (ours.voxel_size, ours.tile_size) != (theirs.voxel_size, theirs.tile_size):
        raise DetectorUnavailable(
            f"model {model} needs voxels of {ours.voxel_size:g} m and tiles of {ours.tile_size}, the map was "
            f"built for {map_model} with {theirs.voxel_size:g} m and {theirs.tile_size}; build a map for it"
        )
    return card


def _own(context: Context, model: str) -> ModelRecord | None:
    """Return the site's own model of that name; None where it is the release's, which comes first, or nobody's."""
    name, _, version = model.partition("/")
    if (context.settings.model_store / name / version / "card.json").exists() or not version.isdecimal():
        return None
    own = context.catalog.models.find(name, int(version))
    return own if own is not None and own.status == "ready" else None


def _own_weights(blob_url: str, job_id: str) -> bytes:
    try:
        return Blobs(blob_url).get_bytes(blob_keys.model_weights(job_id))
    except FileNotFoundError as missing:
        raise DetectorUnavailable(f"the weights of the model of job {job_id} are gone") from missing


def pipeline_settings(context: Context, record: VersionRecord, card: Card) -> PipelineSettings:
    """Return the settings that a version of a map was asked for with, and what the model needs put in its place."""
    asked = PipelineSettings.model_validate(
        {**record.settings, "max_scan_points": context.settings.max_scan_points}
    )
    return asked.for_model(card.preprocessing)
