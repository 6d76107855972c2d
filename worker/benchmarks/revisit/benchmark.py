"""`spicd-worker evaluate revisit`: visits made or found, every method scored, thresholds chosen, figures taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from worker.benchmarks.revisit.baselines import baseline_methods
from worker.benchmarks.revisit.measures import measure, threshold_of
from worker.benchmarks.revisit.methods import Method, from_checkpoint, opened, score_visits
from worker.benchmarks.revisit.pictures import draw
from worker.benchmarks.revisit.plan import (
    TEST_SEED,
    VALIDATION_SEED,
    RevisitSettings,
    VisitPlan,
    plan_visits,
)
from worker.benchmarks.revisit.record import Revisit, ScanErrors
from worker.benchmarks.revisit.tile_table import TileTable, tile_table
from worker.benchmarks.revisit.visits import load_visits, make_visits
from worker.detectors.card import MODEL_STORE
from worker.detectors.store import open_card
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress

VISITS = "visits"  #: folder of what is kept, within the benchmark's own
WRONG = 0.1  #: metres; a pose that is off by this is wrong


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchmarkSettings:
    """What is run."""

    out: Path  #: folder of the visits, which are kept, and of the pictures
    visits: int = 24
    validation: int = 12  #: visits that thresholds are chosen on
    model: str = "spicd-net/1"
    model_store: Path = MODEL_STORE
    weights: tuple[Path, ...] = ()  #: checkpoints, measured instead of the model's own weights
    made: RevisitSettings = field(
        default_factory=RevisitSettings
    )  #: its pipeline gives way to the model's needs
    pictures: bool = True


def evaluate(settings: BenchmarkSettings, progress: Progress = no_progress) -> dict[str, Any]:
    """Run all of it; JSON-ready.

    Raises DetectorUnavailable, MapFailed, OSError for the folder, and ValueError where too few visits are asked for to
    have a changed tile among them.
    """
    card = open_card(settings.model_store, settings.model)
    made = settings.made.model_copy(update={"pipeline": PipelineSettings().for_model(card.preprocessing)})
    methods = _methods(settings)
    test_plans, test, made_now = _visits(settings.visits, TEST_SEED, made, settings.out, progress)
    other_plans, other, made_more = _visits(
        settings.validation, VALIDATION_SEED, made, settings.out, progress
    )
    table, other_table = tile_table(test_plans, test), tile_table(other_plans, other)
    _check(table, "--visits")
    _check(other_table, "--validation")
    found = []
    for method in methods:
        threshold = threshold_of(score_visits(method, other, progress), other_table)
        scored = score_visits(method, test, progress)
        found.append(measure(method.name, scored, table, threshold=threshold, stated=method.stated))
    if settings.pictures:
        progress("drawing", 0.0)
        draw(settings.out, found, table, test)
    return {
        "settings": made.model_dump(mode="json"),
        "seeds": {"test": TEST_SEED, "validation": VALIDATION_SEED},
        "made": made_now + made_more,
        "test": summary(table, test),
        "validation": summary(other_table, other),
        "methods": [
            {**measured.document(), "sha256": method.sha256}
            for method, measured in zip(methods, found, strict=True)
        ],
    }


def summary(table: TileTable, visits: Sequence[Revisit]) -> dict[str, Any]:
    """What there was to find, and what of it nobody looked at."""
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
        "misfit_centimetres": _spread(100 * table.misfit),
        "scans": {
            "first": _scans([visit.first for visit in visits]),
            "second": _scans([visit.second for visit in visits]),
        },
        "by_visit": [_visit(visit) for visit in visits],
    }


def _methods(settings: BenchmarkSettings) -> list[Method]:
    learned = [from_checkpoint(path, settings.model_store, settings.model) for path in settings.weights] or [
        opened(settings.model_store, settings.model)
    ]
    return [*learned, *baseline_methods()]


def _visits(
    count: int, first_seed: int, made: RevisitSettings, out: Path, progress: Progress
) -> tuple[tuple[VisitPlan, ...], tuple[Revisit, ...], int]:
    plans = plan_visits(count, made, first_seed=first_seed)
    place, new = make_visits(plans, made, out / VISITS, progress)
    return plans, load_visits(plans, place), new


def _check(table: TileTable, option: str) -> None:
    if not (table.changed & table.counted).any():
        raise ValueError(f"no changed tile was seen in these visits; ask for more with {option}")


def _visit(visit: Revisit) -> dict[str, Any]:
    return {
        "name": visit.name,
        "tiles": len(visit.cells),
        "observed": int(visit.pairs.observed.sum()),
        "changed": int(visit.exists.sum()) + visit.outside,
        "changed_counted": int((visit.changed & visit.counted).sum()),
        "accepted": visit.second.accepted,
        "scans": visit.second.scans,
        "misfit_centimetres": _spread(100 * visit.misfit),
    }


def _scans(errors: Sequence[ScanErrors]) -> dict[str, Any]:
    """Of all visits; a map counts once a visit to it."""
    metres = np.concatenate([each.metres for each in errors])
    sigmas = np.concatenate([each.sigmas for each in errors])
    stated = sigmas > 0
    return {
        "accepted": len(metres),
        "of": sum(each.scans for each in errors),
        "wrong": int((metres > WRONG).sum()),
        "centimetres": _spread(100 * metres),
        "within_2_sigma": float(np.mean(metres[stated] <= 2 * sigmas[stated])) if stated.any() else None,
    }


def _spread(values: np.ndarray[Any, Any]) -> dict[str, float] | None:
    known = values[~np.isnan(values)]
    if not len(known):
        return None
    return {
        "median": round(float(np.median(known)), 3),
        "95%": round(float(np.percentile(known, 95)), 3),
        "worst": round(float(known.max()), 3),
    }
