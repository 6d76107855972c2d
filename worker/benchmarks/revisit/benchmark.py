"""`spicd-worker evaluate revisit`: visits made or found, every method asked, thresholds chosen, figures taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from worker.benchmarks.documents import Document
from worker.benchmarks.methods import RevisitMethod, ablations, revisit_methods
from worker.benchmarks.revisit.gallery import draw_gallery
from worker.benchmarks.revisit.measures import Measured, scores_of, threshold_of
from worker.benchmarks.revisit.part import RevisitPart, part_of, summary
from worker.benchmarks.revisit.plan import (
    HARD_SEED,
    TEST_SEED,
    VALIDATION_SEED,
    RevisitSettings,
    plan_hard_visits,
    plan_visits,
)
from worker.benchmarks.revisit.report import draw
from worker.benchmarks.revisit.things import HARD_MIN_VOXELS, MIN_VOXELS
from worker.benchmarks.revisit.tiles import TileTable
from worker.detectors.card import MODEL_STORE
from worker.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True, slots=True)
class RevisitBenchmarkSettings:
    """What is run."""

    out: Path  #: folder of the visits, which are kept, and of the pictures
    visits: int = 48
    validation: int = 48  #: visits that thresholds are chosen on
    hard: bool = True  #: also the hard part
    model: str = "voxel-net/1"
    model_store: Path = MODEL_STORE
    weights: tuple[Path, ...] = ()  #: checkpoints, measured instead of the model's own weights
    others: bool = True  #: also the other models of the store, and the baselines
    ablations: bool = False  #: also the model without its gate, and without free space
    made: RevisitSettings = field(default_factory=RevisitSettings)
    pictures: bool = True


def evaluate(settings: RevisitBenchmarkSettings, progress: Progress = no_progress) -> Document:
    """Run all of it, and draw what is to be drawn; JSON-ready.

    Raises DetectorUnavailable, MapFailed, OSError for the folder, and ValueError where too few visits are asked for to
    have a changed tile among them.
    """
    made = settings.made
    methods, left_out = revisit_methods(
        settings.model_store, settings.model, settings.weights, made.pipeline, others=settings.others
    )
    if settings.ablations:
        methods = (*methods, *ablations(settings.model_store, settings.model, made.pipeline))
    parts = visited(settings, progress)
    document: Document = {
        "settings": made.model_dump(mode="json"),
        "seeds": {"test": TEST_SEED, "validation": VALIDATION_SEED, "hard": HARD_SEED},
        "made": sum(part.made for part in parts.values()),
        **{name: summary(part) for name, part in parts.items()},
        "left_out": left_out,
        "methods": [],
    }
    tested = []
    for number, method in enumerate(methods):
        pictures = settings.out if settings.pictures and number == 0 else None
        row, measured = _measured(method, parts, made, pictures, progress)
        document["methods"].append(row)
        tested.append(measured)
    if settings.pictures:
        draw(settings.out, tested, parts["test"].tiles)
    return document


def _measured(
    method: RevisitMethod,
    parts: Mapping[str, RevisitPart],
    made: RevisitSettings,
    pictures: Path | None,
    progress: Progress,
) -> tuple[Document, Measured]:
    """Choose a method's threshold and take its figures; with a folder, draw its mistakes."""
    validation = parts["validation"]
    threshold = threshold_of(scores_of(validation.asked(method, made, progress)), validation.tiles)
    documents, results = {}, {}
    for name in parts.keys() - {"validation"}:
        answers = parts[name].asked(method, made, progress)
        results[name] = parts[name].measured(method, answers, threshold)
        documents[name] = results[name].document(parts[name].things)
        if pictures is not None:
            progress("drawing", 0.0)
            documents[name]["errors"] = draw_gallery(pictures / name, parts[name], results[name], answers)
    hard = {"hard": documents["hard"]} if "hard" in documents else {}
    fingerprint = None if method.detector is None else method.detector.card.fingerprint
    row = {"name": method.name, "sha256": method.sha256, "fingerprint": fingerprint}
    return {**row, **documents["test"], **hard}, results["test"]


def visited(settings: RevisitBenchmarkSettings, progress: Progress = no_progress) -> dict[str, RevisitPart]:
    """Make or find the visits of `test`, `validation` and `hard`. Raises as `evaluate` does."""
    made = settings.made
    plans = {
        "test": plan_visits(settings.visits, made, first_seed=TEST_SEED),
        "validation": plan_visits(settings.validation, made, first_seed=VALIDATION_SEED),
        "hard": plan_hard_visits(made) if settings.hard else (),
    }
    least = {"hard": HARD_MIN_VOXELS}
    parts = {
        name: part_of(chosen, made, settings.out, progress, min_voxels=least.get(name, MIN_VOXELS))
        for name, chosen in plans.items()
        if chosen
    }
    _check(parts["test"].tiles, "--visits")
    _check(parts["validation"].tiles, "--validation")
    if "hard" in parts and not parts["hard"].tiles.changed.any():
        del parts["hard"]
    return parts


def _check(table: TileTable, option: str) -> None:
    if not table.changed.any():
        raise ValueError(f"no changed tile was seen in these visits; ask for more with {option}")
