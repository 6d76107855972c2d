"""The result as one JSON document, the paper's figures beside ours."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from worker.benchmarks.paper.benchmark import Method, PaperResult
from worker.benchmarks.paper.experiment import Kind
from worker.benchmarks.paper.published import published
from worker.benchmarks.paper.robustness import chosen_trials
from worker.metrics import Confusion, confusion, pooled, precision_recall, roc

KINDS: tuple[Kind, ...] = ("add", "remove", "move")
#: The name in the paper's Table 6 of each of ours that it has.
IN_TABLE_6 = {"C2C (mean)": "C2C", "M3C2-approx": "M3C2-approx"}


def document(result: PaperResult) -> dict[str, Any]:
    """JSON-ready; None where a ratio has no meaning."""
    tables = published()
    settings = result.settings
    return {
        "benchmark": "paper",
        "source": tables["source"],
        "model": settings.model if settings.weights is None else settings.weights.name,
        "sha256": result.card.sha256,
        "settings": {
            **asdict(settings.site),
            "validation_seed": settings.validation_seed,
            "everywhere": settings.everywhere,
        },
        "map": {
            "scans": len(result.site.scans),
            "tiles": len(result.site.tiles.points),
            "points": len(result.site.points),
        },
        "validation_map": {
            "scans": len(result.validation.scans),
            "tiles": len(result.validation.tiles.points),
        },
        "thresholds": {
            "validation": result.detector.threshold,
            "test": result.detector.test_threshold,
            "card": result.card.threshold,
            "paper": tables["table_6"]["SPICD-Net"]["threshold"],
        },
        "table_5": _table_5(result),
        "table_6": [_row(method, number == 0) for number, method in enumerate(result.methods)],
        "by_kind": {kind: _kind(result, kind) for kind in KINDS},
        "robustness_experiments": [trial.experiment.name for trial in chosen_trials(result.trials)],
        "robustness": [
            {"disturbance": point.disturbance, "level": point.level, **point.counts.figures()}
            for point in result.robustness
        ],
        "left_out": list(result.left_out),
        "scans_not_registered_again": sum(trial.left_out for trial in result.trials),
        "seconds": round(result.seconds, 1),
        "machine": result.machine,
    }


def counts_of(method: Method, threshold: float) -> tuple[Confusion, ...]:
    """Of each experiment, in their order."""
    return tuple(
        confusion(scores, truth, threshold)
        for scores, truth in zip(method.test.scores, method.test.truths, strict=True)
    )


def _table_5(result: PaperResult) -> list[dict[str, Any]]:
    printed = published()["table_5"]
    ways = [counts_of(result.detector, threshold) for threshold in _both(result.detector)]
    rows = []
    for trial, chosen, best in zip(result.trials, *ways, strict=True):
        one = trial.experiment
        rows.append(
            {
                **asdict(one),
                **chosen.figures(),
                "at_test_threshold": best.figures(),
                "paper": printed[one.name],
            }
        )
    whole, best_whole = (pooled(way) for way in ways)
    aggregated = {"name": "aggregated", **whole.figures(), "at_test_threshold": best_whole.figures()}
    complete = len(result.trials) == len(published()["experiments"])
    return [*rows, {**aggregated, "paper": printed["aggregated"] if complete else None}]


def _row(method: Method, ours: bool) -> dict[str, Any]:
    scores, truth = method.test.pooled, method.test.truth
    found, best = (pooled(counts_of(method, threshold)) for threshold in _both(method))
    return {
        "method": method.test.name,
        "threshold": method.threshold,
        **found.figures(),
        "test_threshold": method.test_threshold,
        "at_test_threshold": best.figures(),
        "area_under_roc": _known(roc(scores, truth).area),
        "average_precision": _known(precision_recall(scores, truth).average_precision),
        "seconds": round(method.test.seconds, 2),
        "paper": published()["table_6"].get("SPICD-Net" if ours else IN_TABLE_6.get(method.test.name, "")),
    }


def _kind(result: PaperResult, kind: Kind) -> dict[str, Any]:
    """Micro-aggregated over the experiments of one operation."""
    rows = {}
    for method in result.methods:
        found, best = (
            pooled(
                counts
                for counts, trial in zip(counts_of(method, threshold), result.trials, strict=True)
                if trial.experiment.operation == kind
            )
            for threshold in _both(method)
        )
        rows[method.test.name] = {"f1": _known(found.f1), "f1_at_test_threshold": _known(best.f1)}
    return rows


def _both(method: Method) -> tuple[float, float]:
    return method.threshold, method.test_threshold


def _known(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 4)
