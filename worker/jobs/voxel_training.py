"""What the steps of a training do where the model scores voxels: the shipped network trained further on one site.

A site alone has too little to train such a network from nothing. It starts from the model that is asked for, or else
from the map's own; what is learned is this place's noise, and how strong a change has to be here.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.catalog.files import blob_keys
from service.catalog.records import ModelRecord, VersionRecord
from worker.cloud import npz
from worker.detectors.card import Card, QuietRecord
from worker.detectors.detector import Detector
from worker.detectors.store import WEIGHTS, Weights, weights_content, weights_of
from worker.detectors.voxel_net.detector import BLIND, SEEING, VoxelNetSettings, joined, weights_under
from worker.detectors.voxel_net.network import VoxelNetwork
from worker.errors import TrainingFailed
from worker.jobs.models import kept_detector
from worker.jobs.scans import kept_scans
from worker.jobs.step import Context, load, put
from worker.pipeline.alarms import region_scores, rest_of, visits_of
from worker.training.voxels.insertion import SiteSettings, site_samples
from worker.training.voxels.publish import site_network
from worker.training.voxels.samples import MISSING, SampleSet, VoxelSample
from worker.training.voxels.trainer import (
    BEST,
    CHECKPOINT,
    LOG,
    VoxelTrainSettings,
    load_checkpoint,
    train_network,
)

DETECTOR = "voxel-net"
SHIPPED = (
    "voxel-net/1"  #: trained further where neither a base is asked for nor the map's model is such a network
)
SITE = SiteSettings(rounds=24)
#: An epoch is short, for a training goes on from the last one that is complete.
TRAINING = VoxelTrainSettings(epochs=30, steps=20, crops=4, learning_rate=3e-4, held_out=4)

#: What a training goes on from, in the order in which it is written.
FILES = tuple(name.format(kind) for kind in (SEEING, BLIND) for name in (BEST, LOG, CHECKPOINT))


@dataclass(frozen=True, kw_only=True, slots=True)
class VoxelTraining:
    """The training of one site's model."""

    model: ModelRecord
    version: VersionRecord  #: of the map, that it is trained on
    card: Card  #: of the model that is trained further

    @property
    def base(self) -> str:
        """The model that is trained further."""
        return self.card.model

    def pack(self, context: Context) -> None:
        """Make samples of the map's own scans. Raises TrainingFailed where they show too little."""
        key_of = functools.partial(blob_keys.map_scan, self.version.job_id)
        context.report("packing", 0.0)
        scans = [load_one() for load_one in kept_scans(context, self.version.scans, key_of)]
        settings = self.card.settings_as(VoxelNetSettings)
        rng = np.random.default_rng(TRAINING.seed)
        voxel_size = self.card.preprocessing.voxel_size
        samples = site_samples(scans, voxel_size, settings.evidence, rng, site=SITE)
        _kind_of(samples)
        put(
            context,
            blob_keys.model_tiles(context.job.job_id),
            lambda path: npz.save(path, SampleSet(samples=tuple(samples))),
        )

    def train(self, context: Context, folder: Path, keep: Callable[[Path], None]) -> None:
        """Train further, for so many minutes. Raises as `train_network` does."""
        samples = self._samples(context)
        kind = _kind_of(samples)
        with kept_detector(context, self.base) as detector:
            start = weights_under(kind, weights_of(detector))
        settings = TRAINING.with_values(
            epochs=self.model.epochs or TRAINING.epochs,
            minutes=self.model.minutes,
            detector=self.card.settings_as(VoxelNetSettings),
        )
        train_network(
            kind,
            samples,
            settings,
            folder,
            lambda _, share: context.report("training", share),
            start=start,
            on_epoch=keep,
        )

    def finish(self, context: Context, folder: Path, command: str) -> tuple[Card, bytes, Path]:
        """Return card and weights of the better of base and trained network, and the log of the training."""
        samples = self._samples(context)
        kind = _kind_of(samples)
        with kept_detector(context, self.base) as detector:
            base = weights_of(detector)
        networks = {name: self._network(weights_under(name, base)) for name in (SEEING, BLIND)}
        state = load_checkpoint(folder / BEST.format(kind))
        held_out = [sample for sample in samples if sample.building % TRAINING.held_out == 0]
        held_out = [sample for sample in held_out if sample.free_space == (kind == SEEING)]
        networks[kind], figures = site_network(networks[kind], self._network(state["network"]), held_out)
        content = weights_content(joined({name: net.state_dict() for name, net in networks.items()}))
        card = self.card.model_copy(
            update={
                "name": self.model.name,
                "version": str(self.model.version),
                "summary": f"Voxel network trained on version {self.model.map_version} of map {self.model.map_id}, "
                f"from {self.base}",
                "weights": WEIGHTS,
                "sha256": hashlib.sha256(content).hexdigest(),
                "training": {
                    "command": command,
                    "base": self.base,
                    "map_id": self.model.map_id,
                    "map_version": self.model.map_version,
                    "kind": kind,
                    "settings": state["settings"],
                    "best_epoch": state["measured"],
                    "seconds": round(state["seconds"]),
                    "samples": len(samples),
                },
                "evaluation": {"validation": figures},
            }
        )
        return card, content, folder / LOG.format(kind)

    def quiet(self, context: Context, card: Card, detector: Detector) -> QuietRecord:
        """Return what the model finds on the map's own scans, where nothing had changed, beside the base's record."""
        key_of = functools.partial(blob_keys.map_scan, self.version.job_id)
        size = card.preprocessing.voxel_size
        visits = visits_of(kept_scans(context, self.version.scans, key_of), voxel_size=size)
        record = self.card.quiet
        scores = [] if record is None else list(record.scores)
        if len(visits) > 1:
            for number, visit in enumerate(visits):
                context.report("calibrating", number / len(visits))
                scores += region_scores(detector, rest_of(visits, number), visit)
        surveys = (0 if record is None else record.surveys) + (len(visits) if len(visits) > 1 else 0)
        return QuietRecord(surveys=max(surveys, 1), scores=tuple(scores))

    def _network(self, state: Weights) -> VoxelNetwork:
        network = self.card.settings_as(VoxelNetSettings).build()
        network.load_state_dict(state)
        return network

    def _samples(self, context: Context) -> list[VoxelSample]:
        key = blob_keys.model_tiles(context.job.job_id)
        return list(load(context, key, functools.partial(npz.load, kind=SampleSet)).samples)


def kept_files(folder: Path) -> list[str]:
    """Return the names of those files that there are."""
    return [name for name in FILES if (folder / name).exists()]


def _kind_of(samples: list[VoxelSample]) -> str:
    """Return which of the two networks the site's scans are for. Raises TrainingFailed where they show too little."""
    for kind in (SEEING, BLIND):
        fitting = [sample for sample in samples if sample.free_space == (kind == SEEING)]
        parts = [
            [sample for sample in fitting if (sample.building % TRAINING.held_out == 0) == held_out]
            for held_out in (True, False)
        ]
        if all(any((sample.labels == MISSING).any() for sample in part) for part in parts):
            return kind
    raise TrainingFailed(
        "the map's scans show too little of each other to train on: no thing put into one of them can be judged by "
        "the others; add scans to the map"
    )
