"""Figures 5 to 15 of the paper, drawn from our own scores, and a ROC."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from worker.benchmarks.paper.benchmark import PaperResult
from worker.benchmarks.paper.experiments import published
from worker.benchmarks.paper.robustness import LEVELS, chosen_trials
from worker.benchmarks.paper.scores import outcomes_of
from worker.benchmarks.plots import (
    COLORS,
    QUIET,
    ScoredTiles,
    TileStyle,
    draw_precision_recall,
    draw_roc,
    label,
    single,
    tile_map,
    training_curves,
)
from worker.cloud.tiling import tile_id
from worker.metrics import PAPER_SWEEP, sweep
from worker.simulation.truth import KINDS

OUTCOMES = {"TP": "#2e7d32", "FN": "#1565c0", "FP": "#c62828", "TN": "#bdbdbd"}  #: the paper's colours
#: Why a picture cannot be drawn, where it cannot.
MISSING = {
    "figure-08": "no log of the training lies beside the weights",
    "figure-09": "none of its experiments was run",
    "figure-10": "none of its experiments was run",
    "figure-11": "it was not asked for",
    "figure-12": "the detector has no descriptors",
    "figure-14": "no change was missed",
}
PREFERRED = "magnitude_15cm"  #: of the paper's Figure 13


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One of the report's pictures, or why it is missing."""

    name: str  #: of its file, without the ending
    caption: str  #: with the paper's number
    figure: Figure | None
    missing: str = ""  #: why there is no figure, where there is none

    @property
    def left_out(self) -> str:
        """A line for the report in the picture's place."""
        return f"{self.caption.partition(':')[0]}; {self.missing}."


def pictures(result: PaperResult) -> list[Picture]:
    """Draw Figures 5 to 15, and a ROC, in the order of the paper; say why one cannot be drawn."""
    disturbed = ", ".join(trial.experiment.name for trial in chosen_trials(result.trials))
    robust = (
        f"Figure 11: robustness, over {disturbed}; a shifted map is not registered again. "
        "Diamonds: F1 as far as the paper's text tells it, on experiments that it does not name."
    )
    rows: tuple[tuple[str, Callable[[PaperResult], Figure | None], str], ...] = (
        ("figure-05", threshold_sensitivity, "Figure 5: sensitivity to the threshold."),
        ("figure-06", precision_recall_curves, "Figure 6: precision and recall."),
        ("roc", roc_curves, "Section 4.3: ROC."),
        ("figure-07", sensitivity_by_kind, "Figure 7: sensitivity by kind of change."),
        ("figure-08", training, "Figure 8: the training behind the weights."),
        ("figure-09", type_series, "Figure 9: the type series."),
        ("figure-10", baseline_and_challenges, "Figure 10: baseline and challenges."),
        ("figure-11", robustness, robust),
        ("figure-12", embedding, "Figure 12: fused embeddings; of the true negatives 15 an experiment."),
        ("figure-13", tiles_from_above, "Figure 13: tiles from above; green found, blue missed, red false alarms."),
        ("figure-14", failure_case, "Figure 14: the missed change with the highest score."),
        ("figure-15", score_distributions, "Figure 15: scores of changed and unchanged tiles."),
    )  # fmt: skip
    return [Picture(name, caption, draw(result), MISSING.get(name, "")) for name, draw, caption in rows]


def training(result: PaperResult) -> Figure | None:
    """Draw Figure 8; None where no log was kept."""
    return None if result.training is None else training_curves(result.training)


def type_series(result: PaperResult) -> Figure | None:
    """Draw Figure 9; None where none of its experiments was run."""
    return confusion_matrices(result, ("type_add", "type_remove", "type_move"), "Type series")


def baseline_and_challenges(result: PaperResult) -> Figure | None:
    """Draw Figure 10; None where none of its experiments was run."""
    names = ("baseline_no_change", "challenge_easy", "challenge_hard")
    return confusion_matrices(result, names, "Baseline and challenges")


def threshold_sensitivity(result: PaperResult) -> Figure:
    """Draw Figure 5."""
    figure, axes = single("Precision, recall and F1 over the threshold")
    rates = sweep(result.detector.test.pooled, result.detector.test.truth)
    for name, color in zip(("precision", "recall", "f1"), COLORS, strict=False):
        axes.plot(rates.thresholds, getattr(rates, name), color=color, label=name)
    _mark_thresholds(axes, result)
    label(axes, "threshold", "share")
    return figure


def sensitivity_by_kind(result: PaperResult) -> Figure:
    """Draw Figure 7."""
    figure, axes = single("F1 over the threshold, by kind of change")
    for kind, color in zip(KINDS, COLORS, strict=False):
        rows = [place for place, one in enumerate(result.trials) if one.experiment.operation == kind]
        if not rows:
            continue
        scores, truths = (
            np.concatenate([part[place] for place in rows])
            for part in (result.detector.test.scores, result.detector.test.truths)
        )
        axes.plot(PAPER_SWEEP, sweep(scores, truths).f1, color=color, label=kind)
    _mark_thresholds(axes, result)
    label(axes, "threshold", "F1")
    return figure


def precision_recall_curves(result: PaperResult) -> Figure:
    """Draw Figure 6, with the baselines."""
    figure, axes = single("Precision over recall")
    draw_precision_recall(axes, _scored_tiles(result))
    paper = published()["table_6"]["SPICD-Net"]
    axes.plot(paper["recall"], paper["precision"], "k*", markersize=11, label="the paper's SPICD-Net")
    label(axes, "recall", "precision")
    return figure


def roc_curves(result: PaperResult) -> Figure:
    """Draw the ROC of Section 4.3."""
    figure, axes = single("Receiver operating characteristic")
    draw_roc(axes, _scored_tiles(result))
    label(axes, "false positive rate", "recall")
    return figure


def _scored_tiles(result: PaperResult) -> list[ScoredTiles]:
    return [
        ScoredTiles(name=method.test.name, scores=method.test.pooled, truth=method.test.truth)
        for method in result.methods
    ]


def score_distributions(result: PaperResult) -> Figure:
    """Draw Figure 15."""
    figure, axes = single("Probability of change, all experiments")
    scores, truth = result.detector.test.pooled, result.detector.test.truth
    bins = [place / 40 for place in range(41)]
    for chosen, color, name in ((~truth, OUTCOMES["TN"], "unchanged"), (truth, COLORS[0], "changed")):
        part = scores[chosen & ~np.isnan(scores)]
        weights = np.full(len(part), 1 / max(len(part), 1))
        axes.hist(part, bins, weights=weights, color=color, alpha=0.7, label=f"{name} ({len(part)} tiles)")
    axes.set_yscale("log")
    _mark_thresholds(axes, result)
    label(axes, "score", "share of tiles")
    return figure


def confusion_matrices(result: PaperResult, names: tuple[str, ...], title: str) -> Figure | None:
    """Draw Figures 9 and 10; None where none of the experiments was run."""
    counts = result.detector.counts(result.detector.threshold)
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


def robustness(result: PaperResult) -> Figure | None:
    """Draw Figure 11; None where nothing was disturbed."""
    if not result.robustness:
        return None
    figure = Figure(figsize=(10, 6), dpi=100, layout="constrained")
    for place, what in enumerate(LEVELS, start=1):
        axes = figure.add_subplot(2, 2, place)
        points = [point for point in result.robustness if point.disturbance == what]
        levels = [point.level for point in points]
        for name, color in zip(("precision", "recall", "f1", "false_positive_rate"), COLORS, strict=False):
            values = [getattr(point.counts, name) for point in points]
            axes.plot(levels, values, "o-", markersize=3, color=color, label=name.replace("_", " "))
        if what == "dropout (%)":
            paper = published()["robustness"]["dropout"]
            shares = [100 * float(level) for level in paper]
            axes.plot(shares, list(paper.values()), "D", color="#555", label="paper, F1")
        axes.set_ylim(-0.03, 1.03)
        label(axes, what, "share")
    return figure


def embedding(result: PaperResult) -> Figure | None:
    """Draw Figure 12; None for a detector without descriptors."""
    projected = result.embedding
    if projected is None:
        return None
    figure, axes = single("Fused embeddings, first two principal directions")
    for outcome, color in OUTCOMES.items():
        x, y = projected.places[projected.outcomes == outcome].T
        axes.scatter(x, y, s=9, color=color, label=f"{outcome} ({len(x)})", alpha=0.8, linewidths=0)
    label(axes, *(f"{share:.0%} of the variance" for share in projected.explained))
    return figure


def _mark_thresholds(axes: Axes, result: PaperResult) -> None:
    method = result.detector
    for threshold, color, style, name in (
        (method.threshold, OUTCOMES["FP"], "--", "chosen on another corridor"),
        (method.test_threshold, QUIET, ":", "best here"),
    ):
        axes.axvline(threshold, color=color, linestyle=style, linewidth=1, label=f"{threshold:.2f}, {name}")


def tiles_from_above(result: PaperResult) -> Figure:
    """Draw Figure 13: the tiles of one experiment, layer by layer."""
    names = [trial.experiment.name for trial in result.trials]
    place = names.index(PREFERRED) if PREFERRED in names else 0
    trial, scores = result.trials[place], result.detector.test.scores[place]
    outcomes = outcomes_of(scores, trial.truth, result.detector.threshold).tolist()
    styles = {
        name: TileStyle(color=color, alpha=0.15 if name == "TN" else 0.6) for name, color in OUTCOMES.items()
    }
    return tile_map(result.site.tiles, outcomes, styles, names[place])


def failure_case(result: PaperResult) -> Figure | None:
    """Draw Figure 14: the missed tile of the highest score, if possible a removed one; None where none was missed."""
    threshold = result.detector.threshold
    missed = [
        (trial.experiment.operation == "remove", float(scores[tile]), place, int(tile))
        for place, (trial, scores) in enumerate(zip(result.trials, result.detector.test.scores, strict=True))
        for tile in np.flatnonzero(trial.truth & (scores <= threshold))
    ]
    if not missed:
        return None
    _, score, place, tile = max(missed)
    return _tile_before_and_after(result, place, tile, f"score {score:.3f}, threshold {threshold:.2f}")


def _tile_before_and_after(result: PaperResult, place: int, tile: int, words: str) -> Figure:
    """Draw a tile of the trial at a place in the order as the map and as the survey has it."""
    trial = result.trials[place]
    traces = [trace for trace in trial.traces if trace.tile == tile]
    gone = np.concatenate([trace.vanished for trace in traces])
    come = np.concatenate([trace.appeared for trace in traces])
    figure = Figure(figsize=(10, 4.8), dpi=100, layout="constrained")
    index, size = result.site.tiles.indices[tile], result.site.tiles.grid.size
    corner, name = result.site.tiles.grid.lower(index), tile_id(index)
    figure.suptitle(
        f"{trial.experiment.name}, {name}: {words}", x=0.01, ha="left", fontsize=11, weight="bold"
    )
    sides = (
        ("reference; red: removed from a scan", trial.pairs.reference.points[tile], gone, "#c62828"),
        ("current; green: added to a scan", trial.pairs.current[tile], come, "#2e7d32"),
    )
    for number, (title, points, marked, color) in enumerate(sides, start=1):
        axes: Any = figure.add_subplot(1, 2, number, projection="3d")
        axes.scatter(*points.T, s=4, color="#1565c0", alpha=0.6, linewidths=0)
        axes.scatter(*marked.T, s=3, color=color, alpha=0.5, linewidths=0)
        limits = np.stack([corner, corner + size]).T
        axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
        axes.set_title(title, fontsize=9)
        axes.set_box_aspect(tuple(size))  # an array it would scale in place
        axes.tick_params(labelsize=6)
    return figure
