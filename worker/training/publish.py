"""Makes a model of a checkpoint: weights, and a card that says what they are (`model_store/`).

It stands apart from training, which needs torch and NumPy alone: a GPU machine hands its checkpoint back.
"""

from __future__ import annotations

import platform
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.cloud.types import Arrays
from worker.detectors.card import Card, PrecisionCheck, Preprocessing
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detector
from worker.detectors.precision import has_bfloat16
from worker.detectors.running.runtime import RunsNetwork, Runtime
from worker.detectors.store import (
    WEIGHTS,
    Weights,
    detector_class,
    make_detector,
    read_card,
    weights_of,
    write_card,
    write_model,
)
from worker.training.calibration import (
    PREVALENCE,
    SurveyPairs,
    area_under_roc,
    best_threshold,
    figures_at,
    survey_pairs,
)
from worker.training.dataset import TileSet, load_tiles, split_tiles
from worker.training.log import HEAD_LOG, LOG
from worker.training.options import OPTIONS
from worker.training.pairs import PairSettings
from worker.training.settings import PAPER, TrainSettings, detector_settings, whole

VOXEL_SIZE, MIN_POINTS = 0.05, 512  #: paper, Table 3; the training tiles are made with the same

PRECISION_PAIRS = (
    256  #: of the validation pairs, that are scored in bfloat16 too, to see whether the scores hold
)

#: What a card says of the pairs that its figures are measured on.
ABOUT_PAIRS = (
    "two independent visits: nothing changed, a synthetic change (paper, Section 3.5.1), or whole things added, "
    "removed and moved where the set has such; no augmentation. Recall, precision and F1 are of whole things where "
    f"there are any, precision and F1 for {PREVALENCE:.0%} changed tiles; threshold of the highest F1 on the validation tiles"
)
CPU = torch.device("cpu")

#: Of the pair settings, what says which synthetic changes there are.
KEPT = ("magnitude", "density", "min_shown", "shown_distance")

#: From the paper, whatever the settings.
DEVIATIONS = (
    "encoder and T-Nets with batch normalisation as in PointNet, which the paper does not mention",
    "patches enter as their distinct points, in training too; augmentation is applied before repetition",
    "the score is 1 - p0, not p1",
)
PAPER_DENSITY = (0.075, 0.075)

#: By the setting that says whether.
OURS = {
    "revisit_share": "revisit_share of the pairs are two independent visits, not one tile sampled twice",
    "edited_share": (
        "edited_share of the changed pairs are visits after whole things were added, removed and moved"
    ),
    "rebuilt_share": (
        "rebuilt_share of the changed pairs were changed in some of the scans that the map is fused of"
    ),
    "chamfer_points": "the Chamfer statistics are of all points of both patches, not of 128 of each",
    "counts": "the head is given point counts beside the Chamfer statistics",
    "noisy_share": "noisy_share of the still pairs have noise of one level on every current point",
    "thinning": "half of the pairs with noise also lose points, up to the share thinning",
    "stored_still": "a stored patch that comes back is not augmented, nor a change of one",
    "matched_pairs": "a changed pair comes with an unchanged one of the same tile",
    "min_shown": "changes that hardly show are drawn again",
    "symmetries": "pairs are turned by the square's symmetries",
    "density": "change density is the range given in settings",
    "initialize_head": (
        "the head's first layers are initialised from data, so that the Chamfer statistics are heard from the start"
    ),
    "head_epochs": "after the last epoch the head was trained on alone, on descriptors computed once",
}


def publish(
    checkpoint: Path,
    tiles: Path,
    model_store: Path,
    *,
    unseen: Path | None = None,
    version: str = "1",
    summary: str | None = None,
    command: str | None = None,
    name: str | None = None,
    about: Mapping[str, Any] | None = None,
    beside: Mapping[str, Detector] | None = None,
    base: str | None = None,
    preprocessing: Preprocessing | None = None,
    stands_on: Detector | None = None,
) -> Path:
    """Write `model_store/<name>/<version>/`, its threshold chosen on the validation tiles; returns the folder.

    `name` is the detector's where it is left out, `command` what `spicd-worker train` takes for the checkpoint's settings,
    `summary` a sentence with both. `unseen` is a training set of other buildings, on which the card's
    evaluation is measured; without one the validation tiles serve for that too, and the card says so. `about` adds to
    what the card says of the training; `beside` are other detectors by name, measured on the validation pairs at their
    own thresholds. `base` names the one of them that was trained further: where that ranks the validation pairs no
    worse, its weights are published, with the threshold that is best here. `preprocessing` is the paper's where it is
    left out. Weights that are those of `stands_on`, as an encoder's of which the head alone was trained, stay there.
    The training's logs, where they lie beside the checkpoint, come along.
    """
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    settings = state["settings"] = whole(state["settings"])
    command = training_command(settings) if command is None else command
    if summary is None:
        title = TrainSettings(detector=settings["detector"]).network.title
        summary = f"{title}, trained by `{command}`"
    training_set = load_tiles(tiles)
    usual = Preprocessing(voxel_size=VOXEL_SIZE, tile_size=training_set.tile_size, min_points=MIN_POINTS)
    card = Card(
        name=name or settings["detector"],
        version=version,
        detector=settings["detector"],
        summary=summary,
        threshold=0.5,
        preprocessing=preprocessing or usual,
        detector_settings=detector_settings(settings),
        weights=WEIGHTS,
        licence="MIT",
        sources=("method: AI 2026, 7(4), 141, https://doi.org/10.3390/ai7040141",),
    )
    pairs = _pairs(split_tiles(training_set, share=settings["held_out"])[1], settings)
    others = {other: _Scored.of(detector, pairs) for other, detector in (beside or {}).items()}
    trained = _Scored.of(detector_class(card.detector).load(card, state["network"], CPU), pairs)
    best, weights = trained, state["network"]
    training = {**_training(state, training_set, command), **(about or {})}
    if base in others and others[base].area >= trained.area:
        best, weights = others[base], weights_of(others[base].detector)
        training["kept"] = f"the weights of {base}: the training ranked the validation pairs no better"
        training["trained"] = trained.area
    threshold = best_threshold(best.scores, pairs).threshold
    unknown = None if unseen is None else _pairs(load_tiles(unseen), settings)
    evaluation = _evaluation(best, threshold, others, unknown)
    final = {"threshold": threshold, "training": training, "evaluation": evaluation}
    aside = model_store / f".partial-{card.name}-{version}"
    shutil.rmtree(aside, ignore_errors=True)
    write_model(aside, card.model_copy(update=final), weights, base=stands_on)
    checks = _precision(aside, {} if stands_on is None else weights_of(stands_on), pairs, command)
    write_card(aside, read_card(aside).model_copy(update={"precision": checks}))
    for log in (LOG, HEAD_LOG):
        if (checkpoint.parent / log).exists():
            shutil.copyfile(checkpoint.parent / log, aside / log)
    return _put(aside, model_store / card.name / version)


def _put(aside: Path, folder: Path) -> Path:
    """Put a whole model in its place, that of an earlier one too."""
    if folder.exists():
        shutil.rmtree(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    return aside.rename(folder)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Scored:
    """A detector and its scores of some pairs."""

    detector: Detector
    pairs: SurveyPairs
    scores: NDArray[np.float32]  #: (P,) probability of change

    @classmethod
    def of(cls, detector: Detector, pairs: SurveyPairs) -> Self:
        """Score the pairs."""
        return cls(detector=detector, pairs=pairs, scores=change_scores(detector, pairs))

    @property
    def area(self) -> float:
        """Chance that a changed pair scores above an unchanged one."""
        return area_under_roc(self.scores, self.pairs)

    def measured(self, threshold: float) -> dict[str, Any]:
        """Return the figures at a threshold, as the card has them."""
        figures = asdict(figures_at(threshold, self.scores, self.pairs))
        return {"pairs": len(self.pairs.kinds), "area_under_roc": self.area, **figures}


def _precision(folder: Path, base: Weights, pairs: SurveyPairs, command: str) -> dict[str, PrecisionCheck]:
    """Score some of the pairs in float32, and in bfloat16 as a processor and as a GPU computes; {} where nothing can.

    The model in the folder is opened for it anew: a detector that somebody else has in hand stays as it is.
    """
    card = read_card(folder)
    content = (folder / str(card.weights)).read_bytes()

    def opened(**how: Any) -> Detector:
        return make_detector(card, content, "cpu", Runtime(**how), base=base)

    exact_detector = opened()
    network = isinstance(exact_detector, RunsNetwork) and "bfloat16" in exact_detector.precisions
    if not (network and has_bfloat16(CPU)):
        return {}
    some = pairs.subset(np.unique(np.linspace(0, len(pairs.kinds) - 1, PRECISION_PAIRS).astype(np.intp)))
    exact = change_scores(exact_detector, some)
    checks = {}
    for kind, device in (("cpu", platform.machine()), ("cuda", f"{platform.machine()}, as a GPU computes")):
        coarse = change_scores(opened(precision="bfloat16", at_once=kind == "cuda"), some)
        checks[kind] = PrecisionCheck(
            largest_score_difference=float(np.abs(coarse - exact).max()),
            decided_otherwise=int(((coarse > card.threshold) != (exact > card.threshold)).sum()),
            tiles=len(some.kinds),
            sha256=str(card.sha256),
            device=device,
            data="validation pairs of the training",
            command=command,
        )
    return checks


def _evaluation(
    best: _Scored, threshold: float, others: Mapping[str, _Scored], unseen: SurveyPairs | None
) -> dict[str, Any]:
    """Return what the card says that the model reaches, on validation pairs and on those of unseen buildings."""
    evaluation: dict[str, Any] = {"validation": best.measured(threshold)}
    for name, scored in others.items():
        evaluation[name] = scored.measured(scored.detector.card.threshold)
    if unseen is not None:
        evaluation["unseen buildings"] = _Scored.of(best.detector, unseen).measured(threshold)
    return {**evaluation, "pairs": ABOUT_PAIRS}


def change_scores(detector: Detector, pairs: SurveyPairs) -> NDArray[np.float32]:
    """Return the probability of change of each pair (P,), by the path that a survey takes.

    Each pair is a map of one tile and a survey of it; a reference that comes again is encoded once.
    """
    size = np.array(detector.card.preprocessing.tile_size)
    grid = TileGrid(origin=-size / 2, size=size, shape=(1, 1, 1))  # its one tile is centred at the origin
    embeddings: dict[int, Arrays] = {}
    scores = []
    for reference, current in zip(pairs.reference, pairs.current, strict=True):
        tiles = Tiles(grid=grid, indices=np.zeros((1, 3), np.int32), points=(reference,))
        comparison = Comparison.of_tiles(
            TilePairs(reference=tiles, current=(current,), observed=np.ones(1, np.bool_))
        )
        if id(reference) not in embeddings:
            embeddings[id(reference)] = detector.encode_reference(comparison.reference, tiles)
        scores.append(detector.detect(comparison, embedding=embeddings[id(reference)]).change)
    return np.concatenate(scores)


def _pairs(tiles: TileSet, settings: dict[str, Any]) -> SurveyPairs:
    kept = {name: value for name, value in settings["pairs"].items() if name in KEPT}
    return survey_pairs(tiles, PairSettings(**kept), seed=settings["seed"])


def _training(state: dict[str, Any], tiles: TileSet, command: str) -> dict[str, Any]:
    return {
        "command": command,
        "settings": {**state["settings"], "start_from": without_place(state["settings"]["start_from"])},
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
    """Return where a training with these settings, as `whole` returns them, departs from the paper, in words."""
    pairs = settings["pairs"]
    ours = {
        **settings,
        **pairs,
        "chamfer_points": pairs["chamfer_points"] is None,
        "density": tuple(pairs["density"]) != PAPER_DENSITY,
        "thinning": min(pairs["noisy_share"], pairs["thinning"]),
    }
    return [*DEVIATIONS, *(words for name, words in OURS.items() if ours[name])]


def training_command(settings: Mapping[str, Any]) -> str:
    """Return the call of `spicd-worker train` that has the settings of a checkpoint, as `whole` returns them."""
    paper = not settings["initialize_head"]
    default = asdict(PAPER if paper else TrainSettings())
    words = ["spicd-worker", "train", "FOLDER", *(["--paper"] if paper else [])]
    for option in OPTIONS:
        value, usual = (
            _values((there["pairs"] if option.of_pairs else there)[option.name])
            for there in (settings, default)
        )
        if value != usual:
            told = [without_place(one) for one in value] if option.name == "start_from" else value
            words += [option.flag, *([] if option.kind is bool else map(str, told))]
    return " ".join(words)


def without_place(path: str | None) -> str | None:
    """Return folder and file of a path, for where on a machine these lay is nobody else's matter."""
    return None if path is None else "/".join(Path(path).parts[-2:])


def _values(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]
