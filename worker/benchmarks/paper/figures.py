"""Figures 5 to 7, 9 to 12 and 15 of the paper, drawn from our own scores, and a ROC."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from worker.benchmarks.paper.benchmark import Method, PaperResult
from worker.benchmarks.paper.document import KINDS, counts_of
from worker.benchmarks.paper.embedding import Embedding
from worker.benchmarks.paper.published import published
from worker.benchmarks.paper.robustness import LEVELS
from worker.metrics import PAPER_SWEEP, precision_recall, roc, sweep

OUTCOMES = {"TN": "#bdbdbd", "TP": "#2e7d32", "FN": "#1565c0", "FP": "#c62828"}  #: the paper's colours
INK, QUIET = "#1a1a1a", "#666666"
LINES = ("#1565c0", "#c62828", "#2e7d32", "#ef6c00", "#6a1b9a")


def threshold_sensitivity(result: PaperResult) -> Figure:
    """Figure 5."""
    figure, axes = _one("Precision, recall and F1 over the threshold")
    found = sweep(result.detector.test.pooled, result.detector.test.truth)
    for name, color in zip(("precision", "recall", "f1"), LINES, strict=False):
        axes.plot(found.thresholds, getattr(found, name), color=color, label=name)
    _mark_thresholds(axes, result)
    _labels(axes, "threshold", "share")
    return figure


def sensitivity_by_kind(result: PaperResult) -> Figure:
    """Figure 7."""
    figure, axes = _one("F1 over the threshold, by kind of change")
    for kind, color in zip(KINDS, LINES, strict=False):
        rows = [place for place, one in enumerate(result.trials) if one.experiment.operation == kind]
        if not rows:
            continue
        scores, truths = (
            np.concatenate([part[place] for place in rows])
            for part in (result.detector.test.scores, result.detector.test.truths)
        )
        axes.plot(PAPER_SWEEP, sweep(scores, truths).f1, color=color, label=kind)
    _mark_thresholds(axes, result)
    _labels(axes, "threshold", "F1")
    return figure


def precision_recall_curves(result: PaperResult) -> Figure:
    """Figure 6, with the baselines."""
    figure, axes = _one("Precision over recall")
    for method, color in zip(result.methods, LINES, strict=False):
        found = precision_recall(method.test.pooled, method.test.truth)
        label = f"{method.test.name}: average precision {found.average_precision:.2f}"
        axes.step(found.recall, found.precision, where="post", color=color, label=label)
    paper = published()["table_6"]["SPICD-Net"]
    axes.plot(paper["recall"], paper["precision"], "k*", markersize=11, label="the paper's SPICD-Net")
    _labels(axes, "recall", "precision")
    axes.set_ylim(0, 1.03)
    return figure


def roc_curves(result: PaperResult) -> Figure:
    """Section 4.3."""
    figure, axes = _one("Receiver operating characteristic")
    for method, color in zip(result.methods, LINES, strict=False):
        found = roc(method.test.pooled, method.test.truth)
        label = f"{method.test.name}: area {found.area:.2f}"
        axes.plot(found.false_positive_rate, found.recall, color=color, label=label)
    axes.plot([0, 1], [0, 1], color=QUIET, linewidth=0.7, linestyle=":")
    _labels(axes, "false positive rate", "recall")
    return figure


def score_distributions(result: PaperResult) -> Figure:
    """Figure 15."""
    figure, axes = _one("Probability of change, all experiments")
    scores, truth = result.detector.test.pooled, result.detector.test.truth
    bins = [place / 40 for place in range(41)]
    for chosen, color, label in ((~truth, OUTCOMES["TN"], "unchanged"), (truth, LINES[0], "changed")):
        part = scores[chosen & ~np.isnan(scores)]
        weights = np.full(len(part), 1 / max(len(part), 1))
        axes.hist(part, bins, weights=weights, color=color, alpha=0.7, label=f"{label} ({len(part)} tiles)")
    axes.set_yscale("log")
    _mark_thresholds(axes, result)
    _labels(axes, "score", "share of tiles")
    return figure


def confusion_matrices(result: PaperResult, names: tuple[str, ...], title: str) -> Figure | None:
    """Figures 9 and 10; None where none of the experiments was run."""
    counts = counts_of(result.detector, result.detector.threshold)
    rows = [
        (trial.experiment.name, one)
        for trial, one in zip(result.trials, counts, strict=True)
        if trial.experiment.name in names
    ]
    if not rows:
        return None
    figure = Figure(figsize=(3.2 * len(rows), 3.2), dpi=100, layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, weight="bold")
    for place, (name, one) in enumerate(rows, start=1):
        axes = figure.add_subplot(1, len(rows), place)
        table = np.array(
            [[one.true_negatives, one.false_positives], [one.false_negatives, one.true_positives]]
        )
        axes.imshow(table / np.maximum(table.sum(axis=1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1.4)
        for row in range(2):
            for column in range(2):
                axes.text(column, row, str(table[row, column]), ha="center", va="center", fontsize=13)
        axes.set_xticks([0, 1], ["unchanged", "changed"], fontsize=8)
        axes.set_yticks([0, 1], ["unchanged", "changed"], fontsize=8, rotation=90, va="center")
        axes.set_xlabel("said", fontsize=8)
        axes.set_title(f"{name}: F1 {one.f1:.2f}" if one.changed else f"{name}", fontsize=9)
    return figure


def robustness(result: PaperResult) -> Figure:
    """Figure 11."""
    figure = Figure(figsize=(10, 6), dpi=100, layout="constrained")
    for place, what in enumerate(LEVELS, start=1):
        axes = figure.add_subplot(2, 2, place)
        points = [point for point in result.robustness if point.disturbance == what]
        levels = [point.level for point in points]
        for name, color in zip(("precision", "recall", "f1", "false_positive_rate"), LINES, strict=False):
            values = [getattr(point.counts, name) for point in points]
            axes.plot(levels, values, "o-", markersize=3, color=color, label=name.replace("_", " "))
        if what == "dropout (%)":
            paper = published()["robustness"]["dropout"]
            axes.plot(
                [100 * float(level) for level in paper],
                list(paper.values()),
                "D",
                color="#555",
                label="paper, F1",
            )
        axes.set_ylim(-0.03, 1.03)
        _labels(axes, what, "share")
    return figure


def embedding(found: Embedding, title: str = "Fused embeddings, first two principal directions") -> Figure:
    """Figure 12."""
    figure, axes = _one(title)
    for outcome, color in OUTCOMES.items():
        here = found.outcomes == outcome
        label = f"{outcome} ({here.sum()})"
        axes.scatter(
            found.places[here, 0],
            found.places[here, 1],
            s=9,
            color=color,
            label=label,
            alpha=0.8,
            linewidths=0,
        )
    _labels(axes, f"{found.explained[0]:.0%} of the variance", f"{found.explained[1]:.0%} of the variance")
    return figure


def _mark_thresholds(axes: Axes, result: PaperResult) -> None:
    method: Method = result.detector
    axes.axvline(
        method.threshold,
        color="#c62828",
        linestyle="--",
        linewidth=1,
        label=f"{method.threshold:.2f}, chosen on another corridor",
    )
    axes.axvline(
        method.test_threshold,
        color=QUIET,
        linestyle=":",
        linewidth=1,
        label=f"{method.test_threshold:.2f}, best here",
    )


def _one(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7, 4.2), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title, loc="left", fontsize=11, color=INK, weight="bold")
    return figure, axes


def _labels(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize=9, color=QUIET)
    axes.set_ylabel(y, fontsize=9, color=QUIET)
    axes.tick_params(labelsize=8, colors=QUIET)
    axes.grid(color="#eeeeee", zorder=0)
    axes.legend(fontsize=8, frameon=False)
