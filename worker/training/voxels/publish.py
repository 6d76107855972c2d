"""Makes a model of the two networks that a training left: calibrated, with a card that says how it was made."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from worker.cloud.types import Bools, Floats
from worker.cloud.voxel_keys import packed, unpacked
from worker.detectors.card import Card, Preprocessing
from worker.detectors.store import WEIGHTS, write_model
from worker.detectors.voxel_net.detector import BLIND, SEEING, joined
from worker.detectors.voxel_net.network import VoxelNetwork, probabilities
from worker.detectors.voxels.scores import TileScoreSettings
from worker.metrics import precision_recall
from worker.training.voxels.samples import MISSING, UNKNOWN, VoxelSample
from worker.training.voxels.trainer import VoxelTrainSettings

CPU = torch.device("cpu")
TILE = (30, 30, 20)  #: voxels, of the tiles that the tile score is fitted on: the paper's 1.5 x 1.5 x 1.0 m
MIN_CHANGED = 40  #: voxels that make a changed tile, as in the benchmark
_ROUNDS = 50  # of Newton's method; it settles within ten
_APART = 400  # tiles between two samples: no building is as long
_BINS = 15  # of the expected calibration error (Guo et al., ICML 2017)

#: What a card says of where the figures on held-out samples come from.
ABOUT = "voxels of held-out simulated buildings, all views; a voxel is missing where the thing hit is not in the other visit"

ABOUT_SITE = "voxels of the map's own scans, parted in two visits with solids put into either; rounds that training held out"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Scored:
    """Logits of the voxels of held-out samples whose truth is known."""

    logits: Floats  #: (N,)
    missing: Bools  #: (N,)
    tiles: NDArray[np.int64]  #: (N,) which tile of which sample each is of

    @property
    def probabilities(self) -> Floats:
        """(N,)"""
        return np.asarray(1 / (1 + np.exp(-self.logits)))


def publish(
    checkpoints: dict[str, Path],
    samples: Sequence[VoxelSample],
    model_store: Path,
    *,
    version: str = "1",
    summary: str,
    command: str,
    about: dict[str, Any] | None = None,
) -> Path:
    """Write `model_store/voxel-net/<version>/` of the checkpoints by network; returns the folder.

    Both networks' probabilities, then the tiles' score, are calibrated on the samples that training held out. `about`
    adds to what the card says of the training.
    """
    states = {
        name: torch.load(path, map_location="cpu", weights_only=True) for name, path in checkpoints.items()
    }
    settings = {name: VoxelTrainSettings.model_validate(state["settings"]) for name, state in states.items()}
    networks, figures = {}, {}
    tiles = TileScoreSettings.model_validate({})
    for name in (SEEING, BLIND):
        network = settings[name].detector.build()
        network.load_state_dict(states[name]["network"])
        held_out = [
            sample
            for sample in samples
            if sample.building % settings[name].held_out == 0 and sample.free_space == (name == SEEING)
        ]
        before = _scored(network.eval(), held_out)
        slope, offset = logistic_fit(before.logits, before.missing)
        _rescale(network, slope, offset)
        after = _scored(network, held_out)
        if name == SEEING:
            tiles = fitted_tiles(after)
        networks[name] = network
        figures[name] = _figures(after) | {
            "before_calibration": calibration_error(before.probabilities, before.missing)
        }
    detector_settings = settings[SEEING].detector.with_values(tiles=tiles).model_dump(mode="json")
    card = Card(
        name="voxel-net",
        version=version,
        detector="voxel-net",
        summary=summary,
        threshold=0.5,
        preprocessing=Preprocessing(
            voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=1, tiles="touched"
        ),
        detector_settings=detector_settings,
        weights=WEIGHTS,
        training={
            "command": command,
            **{name: _training(states[name]) for name in states},
            "samples": len(samples),
            "buildings": len({sample.building for sample in samples}),
            "torch": torch.__version__,
            "machine": platform.machine(),
            **(about or {}),
        },
        evaluation={"held_out": {**figures, "about": ABOUT}},
        licence="MIT",
    )
    weights = joined({name: network.state_dict() for name, network in networks.items()})
    return write_model(model_store / card.name / version, card, weights)


def site_network(
    base: VoxelNetwork, trained: VoxelNetwork, samples: Sequence[VoxelSample]
) -> tuple[VoxelNetwork, dict[str, Any]]:
    """Return whichever network ranks a site's held-out samples better, calibrated on them, and figures of both."""
    scored = {"base": _scored(base.eval(), samples), "trained": _scored(trained.eval(), samples)}
    figures: dict[str, Any] = {name: _figures(told) for name, told in scored.items()}
    better = figures["trained"]["average_precision"] > figures["base"]["average_precision"]
    kept = "trained" if better else "base"
    network, told = (trained if better else base), scored[kept]
    if min(told.missing.sum(), (~told.missing).sum()) >= MIN_CHANGED:
        _rescale(network, *logistic_fit(told.logits, told.missing))
    return network, {
        **figures,
        "kept": kept,
        "calibrated": _figures(_scored(network, samples)),
        "about": ABOUT_SITE,
    }


def logistic_fit(values: Floats, truth: Bools) -> tuple[float, float]:
    """Return slope and offset of the logistic curve over values (N,) that fits the truth best (Platt, 1999)."""
    design = np.stack([values, np.ones_like(values)], axis=1)
    fitted = np.array([1.0, 0.0])
    for _ in range(_ROUNDS):
        p = 1 / (1 + np.exp(-np.clip(design @ fitted, -30, 30)))
        gradient = design.T @ (p - truth) + 1e-6 * fitted
        hessian = (design * (p * (1 - p))[:, None]).T @ design + 1e-6 * np.eye(2)
        step = np.linalg.solve(hessian, gradient)
        fitted -= np.clip(step, -2, 2)
        if np.abs(step).max() < 1e-6:
            break
    return float(fitted[0]), float(fitted[1])


def fitted_tiles(scored: _Scored) -> TileScoreSettings:
    """Fit the tile score to tiles of at least 40 missing voxels, or of none; those between say nothing."""
    _, tile = np.unique(scored.tiles, return_inverse=True)
    expected = np.bincount(tile, weights=scored.probabilities)
    missing = np.bincount(tile, weights=scored.missing)
    clear = (missing == 0) | (missing >= MIN_CHANGED)
    slope, offset = logistic_fit(np.log1p(expected[clear]), missing[clear] > 0)
    return TileScoreSettings(slope=slope, offset=offset)


def calibration_error(probabilities_: Floats, truth: Bools) -> float:
    """Return the expected calibration error: mean gap of probability and share, over 15 bins, by their weight."""
    place = np.minimum((probabilities_ * _BINS).astype(np.int64), _BINS - 1)
    gaps = np.bincount(place, weights=probabilities_ - truth, minlength=_BINS)
    return float(np.abs(gaps).sum() / max(len(truth), 1))


def _scored(network: VoxelNetwork, samples: Sequence[VoxelSample]) -> _Scored:
    logits, missing, tiles = [], [], []
    for number, sample in enumerate(samples):
        known = sample.labels != UNKNOWN
        p = probabilities(network, sample.keys, sample.channels.astype(np.float32), CPU)[known]
        p = np.clip(p.astype(np.float64), 1e-6, 1 - 1e-6)
        logits.append(np.log(p / (1 - p)))
        missing.append(sample.labels[known] == MISSING)
        tile = np.floor_divide(unpacked(sample.keys[known]), TILE)
        tile[:, 0] += number * _APART
        tiles.append(packed(tile))
    return _Scored(
        logits=np.concatenate(logits), missing=np.concatenate(missing), tiles=np.concatenate(tiles)
    )


def _rescale(network: VoxelNetwork, slope: float, offset: float) -> None:
    """Fold the calibration into the last layer."""
    last = network.head[-1]
    if not isinstance(last, nn.Linear):
        raise TypeError(f"the head ends in a {type(last).__name__}")
    with torch.no_grad():
        last.weight.mul_(slope)
        last.bias.mul_(slope).add_(offset)


def _figures(scored: _Scored) -> dict[str, Any]:
    p = scored.probabilities
    return {
        "voxels": len(p),
        "missing": int(scored.missing.sum()),
        "average_precision": round(precision_recall(p, scored.missing).average_precision, 4)
        if scored.missing.any()
        else 0.0,
        "expected_calibration_error": round(calibration_error(p, scored.missing), 5),
    }


def _training(state: dict[str, Any]) -> dict[str, Any]:
    return {
        "settings": state["settings"],
        "seconds": round(state["seconds"]),
        "best_epoch": state["measured"],
    }
