"""The model of a job: opened once a process, and held against the map."""

from __future__ import annotations

import functools
from pathlib import Path

from service.catalog.records import VersionRecord
from service.settings import Settings
from worker.detectors.card import Card
from worker.detectors.detector import Detector
from worker.detectors.store import open_card, open_detector
from worker.errors import DetectorUnavailable
from worker.jobs.step import Context
from worker.pipeline.flow import PipelineSettings


@functools.lru_cache(maxsize=4)
def _opened(model_store: Path, model: str, device: str) -> Detector:
    return open_detector(model_store, model, device)  # type: ignore[arg-type]  # Settings checked the device


def kept_detector(settings: Settings, model: str) -> Detector:
    """The network, kept between jobs by the inference worker's process."""
    return _opened(settings.model_store, model, settings.device)


def card_that_fits(settings: Settings, model: str, map_model: str) -> Card:
    """The survey's model must cut the world as the map was cut."""
    card, built_with = (open_card(settings.model_store, name) for name in (model, map_model))
    ours, theirs = card.preprocessing, built_with.preprocessing
    same = (ours.voxel_size, ours.tile_size, ours.min_points) == (
        theirs.voxel_size,
        theirs.tile_size,
        theirs.min_points,
    )
    if not same:
        raise DetectorUnavailable(
            f"model {model} needs voxels of {ours.voxel_size:g} m and tiles of {ours.tile_size}, the map was "
            f"built for {map_model} with {theirs.voxel_size:g} m and {theirs.tile_size}; build a map for it"
        )
    return card


def pipeline_settings(at: Context, record: VersionRecord, card: Card) -> PipelineSettings:
    asked = PipelineSettings.model_validate(
        {**record.settings, "max_scan_points": at.settings.max_scan_points}
    )
    return asked.for_model(card.preprocessing)
