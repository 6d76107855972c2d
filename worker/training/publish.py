"""Makes a model of a checkpoint: weights, and a card that says what they are (`model_store/`).

It stands apart from training, which needs torch and NumPy alone: a GPU machine hands its checkpoint back.
"""

from __future__ import annotations

import argparse
import platform
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.cloud.types import Points
from worker.detectors.card import MODEL_STORE, Card, Preprocessing
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.store import WEIGHTS, write_model
from worker.training.calibration import (
    PREVALENCE,
    SurveyPairs,
    area_under_roc,
    best_threshold,
    operating,
    survey_pairs,
)
from worker.training.dataset import TileSet, load_tiles, split_tiles
from worker.training.log import LOG
from worker.training.pairs import PairSettings

VOXEL_SIZE, MIN_POINTS = 0.05, 512  #: paper, Table 3; the training tiles are made with the same

#: Of the pair settings, what says which synthetic changes there are.
KEPT = ("magnitude", "density", "min_shown", "shown_distance")

#: From the paper, whatever the settings.
DEVIATIONS = (
    "encoder and T-Nets with batch normalisation as in PointNet, which the paper does not mention",
    "patches enter as their distinct points, in training too; augmentation is applied before repetition",
    "the score is 1 - p0, not p1",
)
PAPER_DENSITY = (0.075, 0.075)


def publish(
    checkpoint: Path,
    tiles: Path,
    model_store: Path,
    *,
    unseen: Path | None = None,
    version: str = "1",
    summary: str,
    command: str = "",
    name: str = "spicd-net",
    about: Mapping[str, Any] | None = None,
    beside: Mapping[str, SpicdNet] | None = None,
    base: str | None = None,
    preprocessing: Preprocessing | None = None,
) -> Path:
    """Write `model_store/<name>/<version>/`, its threshold chosen on the validation tiles; returns the folder.

    `unseen` is a training set of other buildings, on which the card's evaluation is measured; without one
    the validation tiles serve for that too, and the card says so. `about` adds to what the card says of the
    training; `beside` are other detectors by name, measured on the validation pairs at their own thresholds.
    `base` names the one of them that was trained further: where that ranks the validation pairs no worse, its weights are published, with the
    threshold that is best here. `preprocessing` is the paper's where it is left out.
    The training's log, where it lies beside the checkpoint, comes along.
    """
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    settings, training_set = state["settings"], load_tiles(tiles)
    validation = split_tiles(training_set, share=settings["held_out"])[1]
    card = Card(
        name=name,
        version=version,
        detector="spicd-net",
        summary=summary,
        threshold=0.5,
        preprocessing=preprocessing
        or Preprocessing(
            voxel_size=VOXEL_SIZE,
            tile_size=training_set.tile_size,
            patch_points=settings["pairs"]["patch_points"],
            chamfer_points=settings["pairs"]["chamfer_points"],
            min_points=MIN_POINTS,
            seed=settings["seed"],
        ),
        weights=WEIGHTS,
        training={**_training(state, training_set, command), **(about or {})},
        licence="MIT",
        sources=("method: AI 2026, 7(4), 141, https://doi.org/10.3390/ai7040141",),
    )
    detector = SpicdNet.load(card, state["network"], torch.device("cpu"))
    pair_settings = _pair_settings(settings)
    pairs = survey_pairs(validation, pair_settings, seed=settings["seed"])
    network, scores = state["network"], change_scores(detector, pairs)
    others = {other: change_scores(one, pairs) for other, one in (beside or {}).items()}
    if beside and base in others and _area(others[base], pairs) >= _area(scores, pairs):
        kept = {
            "kept": f"the weights of {base}: the training ranked the validation pairs no better",
            "trained": _area(scores, pairs),
        }
        card = card.model_copy(update={"training": {**card.training, **kept}})
        detector, network, scores = beside[base], beside[base].weights(), others[base]
    chosen = best_threshold(scores, pairs)
    evaluation: dict[str, Any] = {"validation": _measured(chosen.threshold, scores, pairs)}
    for other, found in others.items():
        evaluation[other] = _measured((beside or {})[other].card.threshold, found, pairs)
    if unseen is not None:
        unknown = survey_pairs(load_tiles(unseen), pair_settings, seed=settings["seed"])
        evaluation["unseen buildings"] = _measured(
            chosen.threshold, change_scores(detector, unknown), unknown
        )
    evaluation["pairs"] = (
        "two independent visits: nothing changed, a synthetic change (paper, Section 3.5.1), or whole things added, removed and moved "
        "where the set has such; no augmentation. Recall, precision and F1 are of whole things where there are any, precision and F1 "
        f"for {PREVALENCE:.0%} changed tiles; threshold of the highest F1 on the validation tiles"
    )
    folder = write_model(
        model_store / name / version,
        card.model_copy(update={"threshold": chosen.threshold, "evaluation": evaluation}),
        network,
    )
    _take_log(checkpoint.parent / LOG, folder / LOG)
    return folder


def change_scores(detector: SpicdNet, pairs: SurveyPairs) -> NDArray[np.float32]:
    """(P,) probability of change, by the path that a survey takes; a reference that comes again is described once."""
    size = np.array(detector.card.preprocessing.tile_size)
    grid = TileGrid(origin=-size / 2, size=size, shape=(1, 1, 1))  # its one tile is centred at the origin

    def tiles(points: tuple[Points, ...]) -> Tiles:
        return Tiles(grid=grid, indices=np.zeros((len(points), 3), np.int32), points=points)

    place: dict[int, int] = {}
    rows = np.array([place.setdefault(id(points), len(place)) for points in pairs.reference], np.int64)
    firsts = np.unique(rows, return_index=True)[1]
    known = detector.describe(tiles(tuple(pairs.reference[first] for first in firsts)))
    return detector.score(
        TilePairs(
            reference=tiles(pairs.reference),
            current=pairs.current,
            observed=np.ones(len(rows), dtype=np.bool_),
        ),
        description={name: values[rows] for name, values in known.items()},
    ).change


def _area(scores: NDArray[np.float32], pairs: SurveyPairs) -> float:
    """Under ROC, over the pairs that the threshold is chosen by."""
    return area_under_roc(scores[pairs.told], pairs.changed[pairs.told])


def _measured(threshold: float, scores: NDArray[np.float32], pairs: SurveyPairs) -> dict[str, Any]:
    return {
        "pairs": len(pairs.kinds),
        "area_under_roc": _area(scores, pairs),
        **asdict(operating(threshold, scores, pairs)),
    }


def _training(state: dict[str, Any], tiles: TileSet, command: str) -> dict[str, Any]:
    return {
        "command": command,
        "settings": state["settings"],
        "best_epoch": state["best_epoch"],
        "seconds_to_best": round(state["seconds"]),
        "paper": "up to 1,000 epochs, 276 run (Section 3.8)",
        "validation_pairs": state["measured"],
        **({"head_alone": state["head"]} if "head" in state else {}),
        "tiles": len(tiles),
        "tile_source": tiles.source,
        "deviations": deviations(state["settings"]),
        "torch": torch.__version__,
        "machine": platform.machine(),
    }


def deviations(settings: dict[str, Any]) -> list[str]:
    """Where a training with these settings departs from the paper, in words. An older checkpoint has ours."""
    pairs = settings["pairs"]
    ours = {
        "revisit_share of the pairs are two independent visits, not one tile sampled twice": pairs[
            "revisit_share"
        ]
        > 0,
        "edited_share of the changed pairs are visits after whole things were added, removed and moved": (
            pairs.get("edited_share", 0.0) > 0
        ),
        "rebuilt_share of the changed pairs were changed in some of the scans that the map is fused of": (
            pairs.get("rebuilt_share", 0.0) > 0
        ),
        "the Chamfer statistics are of all points of both patches, not of 128 of each": (
            pairs.get("chamfer_points", 128) is None
        ),
        "a stored patch that comes back is not augmented, nor a change of one": pairs.get(
            "stored_still", False
        ),
        "a changed pair comes with an unchanged one of the same tile": pairs.get("twins", True),
        "changes that hardly show are drawn again": pairs["min_shown"] > 0,
        "pairs are turned by the square's symmetries": pairs["symmetries"],
        "change density is the range given in settings": tuple(pairs["density"]) != PAPER_DENSITY,
        "the head's first layers are initialised from data, so that the Chamfer statistics are heard from the start": (
            settings.get("settle_head", True)
        ),
        "after the last epoch the head was trained on alone, on descriptors computed once": (
            settings.get("head_epochs", 0) > 0
        ),
    }
    return [*DEVIATIONS, *(words for words, true in ours.items() if true)]


def _pair_settings(settings: dict[str, Any]) -> PairSettings:
    kept = {name: value for name, value in settings["pairs"].items() if name in KEPT}
    return PairSettings(**kept)


def _take_log(log: Path, place: Path) -> None:
    """None rather than that of an earlier training."""
    if log.exists():
        shutil.copyfile(log, place)
    else:
        place.unlink(missing_ok=True)


def main() -> None:
    """`python -m worker.training.publish CHECKPOINT TILES`"""
    parser = argparse.ArgumentParser(prog="python -m worker.training.publish")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("tiles", type=Path, help="the training set that it was made with")
    parser.add_argument("--unseen", type=Path, help="tiles of other buildings, to measure on")
    parser.add_argument("--store", type=Path, default=MODEL_STORE)
    parser.add_argument("--version", default="1")
    parser.add_argument("--summary", default="SPICD-Net as the paper describes it")
    parser.add_argument("--command", default="", help="how the training was started, for the card")
    given = parser.parse_args()
    folder = publish(
        given.checkpoint,
        given.tiles,
        given.store,
        unseen=given.unseen,
        version=given.version,
        summary=given.summary,
        command=given.command,
    )
    sys.stdout.write(f"{folder}\n")


if __name__ == "__main__":
    main()
