"""The model of a job, of the release or the site's own: opened once a process, and held against the map."""

from __future__ import annotations

import functools
from pathlib import Path

from service.catalog import blob_keys
from service.catalog.blobs import Blobs
from service.catalog.records import ModelRecord, VersionRecord
from worker.detectors.card import Card
from worker.detectors.detector import Detector
from worker.detectors.store import Device, make_detector, open_card, open_detector
from worker.errors import DetectorUnavailable
from worker.jobs.step import Context
from worker.pipeline.settings import PipelineSettings


def kept_detector(at: Context, model: str) -> Detector:
    """The network, kept between jobs by the inference worker's process. Raises DetectorUnavailable."""
    own, settings = _own(at, model), at.settings
    if own is None:
        return _opened(settings.model_store, model, settings.device)
    card = Card.model_validate(own.card).model_dump_json()
    return _opened_own(settings.resolved_blob_url(), own.job_id, card, settings.device)


def card_of(at: Context, model: str) -> Card:
    """The card of `name/version`. Raises DetectorUnavailable."""
    own = _own(at, model)
    return open_card(at.settings.model_store, model) if own is None else Card.model_validate(own.card)


def card_that_fits(at: Context, model: str, map_model: str) -> Card:
    """A model that scores a map must cut the world as the map was cut. Raises DetectorUnavailable."""
    card, built_with = (card_of(at, name) for name in (model, map_model))
    ours, theirs = card.preprocessing, built_with.preprocessing
    if ours != theirs:
        raise DetectorUnavailable(
            f"model {model} needs voxels of {ours.voxel_size:g} m and tiles of {ours.tile_size}, the map was "
            f"built for {map_model} with {theirs.voxel_size:g} m and {theirs.tile_size}; build a map for it"
        )
    return card


def _own(at: Context, model: str) -> ModelRecord | None:
    """The site's own model of that name; None where it is the release's, which comes first, or nobody's."""
    name, _, version = model.partition("/")
    if (at.settings.model_store / name / version / "card.json").exists() or not version.isdecimal():
        return None
    own = at.catalog.models.find(name, int(version))
    return own if own is not None and own.status == "ready" else None


@functools.lru_cache(maxsize=4)
def _opened(model_store: Path, model: str, device: Device) -> Detector:
    return open_detector(model_store, model, device)


@functools.lru_cache(maxsize=4)
def _opened_own(blob_url: str, job_id: str, card: str, device: Device) -> Detector:
    """By its job, for a name and number may come again once the map is deleted."""
    try:
        content = Blobs(blob_url).get_bytes(blob_keys.model_weights(job_id))
    except FileNotFoundError as missing:
        raise DetectorUnavailable(f"the weights of the model of job {job_id} are gone") from missing
    return make_detector(Card.model_validate_json(card), content, device)


def pipeline_settings(at: Context, record: VersionRecord, card: Card) -> PipelineSettings:
    """Return the settings that a version of a map was asked for with, and what the model needs put in its place."""
    asked = PipelineSettings.model_validate(
        {**record.settings, "max_scan_points": at.settings.max_scan_points}
    )
    return asked.for_model(card.preprocessing)
