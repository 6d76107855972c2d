"""The model of a job, of the release or the site's own: opened once a process, and held against the map."""

from __future__ import annotations

import functools
from pathlib import Path

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from service.catalog.records import ModelRecord, VersionRecord
from worker.detectors.card import Card
from worker.detectors.detector import Detector
from worker.detectors.store import Device, make_detector, open_card, open_detector, resolve_device
from worker.errors import DetectorUnavailable
from worker.jobs.step import Context
from worker.pipeline.settings import PipelineSettings


def finds_gpu() -> bool:
    """Tell whether torch finds the GPU that `cuda` asks for."""
    try:
        resolve_device("cuda")
    except DetectorUnavailable:
        return False
    return True


def kept_detector(context: Context, model: str) -> Detector:
    """Return the network, kept between jobs by the inference worker's process. Raises DetectorUnavailable."""
    own, settings = _own(context, model), context.settings
    if own is None:
        return _opened(settings.model_store, model, settings.device)
    card = Card.model_validate(own.card).model_dump_json()
    return _opened_own(settings.resolved_blob_url(), own.job_id, card, settings.device)


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


@functools.lru_cache(maxsize=4)
def _opened(model_store: Path, model: str, device: Device) -> Detector:
    return open_detector(model_store, model, device)


@functools.lru_cache(maxsize=4)
def _opened_own(blob_url: str, job_id: str, card: str, device: Device) -> Detector:
    """Open by its job, for a name and number may come again once the map is deleted."""
    try:
        content = Blobs(blob_url).get_bytes(blob_keys.model_weights(job_id))
    except FileNotFoundError as missing:
        raise DetectorUnavailable(f"the weights of the model of job {job_id} are gone") from missing
    return make_detector(Card.model_validate_json(card), content, device)


def pipeline_settings(context: Context, record: VersionRecord, card: Card) -> PipelineSettings:
    """Return the settings that a version of a map was asked for with, and what the model needs put in its place."""
    of_the_service = {
        "max_scan_points": context.settings.max_scan_points,
        "memory_bytes": context.settings.map_memory_bytes,
    }
    asked = PipelineSettings.model_validate({**record.settings, **of_the_service})
    return asked.for_model(card.preprocessing)
