"""`spicd-worker evaluate revisit`: visits made or found, every method scored, thresholds chosen, figures taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from worker.benchmarks.documents import Document, spread
from worker.benchmarks.methods import baseline_methods, detector_methods
from worker.benchmarks.revisit.measures import TileTable, measure, score_visits, threshold_of, tile_table
from worker.benchmarks.revisit.plan import TEST_SEED, VALIDATION_SEED, RevisitSettings, plan_visits
from worker.benchmarks.revisit.report import draw
from worker.benchmarks.revisit.visits import Revisit, ScanErrors, load_visits, make_visits
from worker.benchmarks.trajectory import WRONG
from worker.cloud.types import Floats
from worker.detectors.card import MODEL_STORE
from worker.detectors.store import open_card
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

VISITS = "visits"  #: folder of what is kept, within the benchmark's own


@dataclass(frozen=True, kw_only=True, slots=True)
class RevisitBenchmarkSettings:
    """What is run."""

    out: Path  #: folder of the visits, which are kept, and of the pictures
    visits: int = 24
    validation: int = 12  #: visits that thresholds are chosen on
    model: str = "spicd-net/1"
    model_store: Path = MODEL_STORE
    weights: tuple[Path, ...] = ()  #: checkpoints, measured instead of the model's own weights
    #: its pipeline gives way to the model's needs
    made: RevisitSettings = field(default_factory=RevisitSettings)
    pictures: bool = True


def evaluate(settings: RevisitBenchmarkSettings, progress: Progress = no_progress) -> Document:
    """Run all of it, and draw what is to be drawn; JSON-ready.

    Raises DetectorUnavailable, MapFailed, OSError for the folder, and ValueError where too few visits are asked for to
    have a changed tile among them.
    """
    card = open_card(settings.model_store, settings.model)
    made = settings.made.model_copy(update={"pipeline": PipelineSettings().for_model(card.preprocessing)})
    ours = detector_methods(settings.model_store, settings.model, settings.weights)
    methods = (*ours, *baseline_methods())
    test, table, made_now = _visits(settings.visits, TEST_SEED, made, settings.out, progress)
    other, other_table, made_more = _visits(
        settings.validation, VALIDATION_SEED, made, settings.out, progress
    )
    _check(table, "--visits")
    _check(other_table, "--validation")
    measured = []
    for method in methods:
        threshold = threshold_of(score_visits(method, other, progress), other_table)
        scores = score_visits(method, test, progress)
        measured.append(measure(method.name, scores, table, threshold=threshold, stated=method.stated))
    if settings.pictures:
        progress("drawing", 0.0)
        draw(settings.out, measured, table, test)
    return {
        "settings": made.model_dump(mode="json"),
        "seeds": {"test": TEST_SEED, "validation": VALIDATION_SEED},
        "made": made_now + made_more,
        "test": summary(table, test),
        "validation": summary(other_table, other),
        "methods": [
            {**row.document(), "sha256": method.sha256} for method, row in zip(methods, measured, strict=True)
        ],
    }


def summary(table: TileTable, visits: Sequence[Revisit]) -> Document:
    """Say what there was to find, and what of it nobody looked at."""
    changed = table.changed
    return {
        "visits": len(visits),
        "without_change": len(np.unique(table.visit[table.case == "unchanged"])),
        "tiles": len(changed),
        "observed": int(table.observed.sum()),
        "changed": {
            "counted": int((changed & table.counted).sum()),
            "unobserved": int((changed & ~table.observed).sum()),
            "out_of_sight": int((changed & table.observed & ~table.counted).sum()),
            "outside_the_map": sum(visit.outside for visit in visits),
        },
        "misfit_centimetres": _centimetres(table.misalignment),
        "scans": {
            "first": _scans([visit.first for visit in visits]),
            "second": _scans([visit.second for visit in visits]),
        },
        "by_visit": [_visit(visit) for visit in visits],
    }


def _visits(
    count: int, first_seed: int, made: RevisitSettings, out: Path, progress: Progress
) -> tuple[tuple[Revisit, ...], TileTable, int]:
    """Return the visits, their tiles, and how many of the visits had to be made."""
    plans = plan_visits(count, made, first_seed=first_seed)
    place, new = make_visits(plans, made, out / VISITS, progress)
    visits = load_visits(plans, place)
    return visits, tile_table(plans, visits), new


def _check(table: TileTable, option: str) -> None:
    if not (table.changed & table.counted).any():
        raise ValueError(f"no changed tile was seen in these visits; ask for more with {option}")


def _visit(visit: Revisit) -> Document:
    return {
        "name": visit.name,
        "tiles": len(visit.cells),
        "observed": int(visit.pairs.observed.sum()),
        "changed": int(visit.exists.sum()) + visit.outside,
        "changed_counted": int((visit.changed & visit.counted).sum()),
        "accepted": visit.second.accepted,
        "scans": visit.second.scans,
        "misfit_centimetres": _centimetres(visit.misalignment),
    }


def _scans(errors: Sequence[ScanErrors]) -> Document:
    """Summarize the scans of all visits; a map counts once a visit to it."""
    metres = np.concatenate([visit.metres for visit in errors])
    sigmas = np.concatenate([visit.sigmas for visit in errors])
    stated = sigmas > 0
    return {
        "accepted": len(metres),
        "of": sum(visit.scans for visit in errors),
        "wrong": int((metres > WRONG).sum()),
        "centimetres": _centimetres(metres),
        "within_2_sigma": float(np.mean(metres[stated] <= 2 * sigmas[stated])) if stated.any() else None,
    }


def _centimetres(metres: Floats) -> Document | None:
    return spread(100 * metres, "median", "95%", "worst", digits=3)
