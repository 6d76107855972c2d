"""The figures of `spicd-worker evaluate revisit` as tables on a terminal, and its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Group
from rich.table import Table

from worker.benchmarks import plots
from worker.benchmarks.documents import Document, shown, titled_table
from worker.benchmarks.methods import TileScore
from worker.benchmarks.plots import FOUND, MISSED, QUIET, WRONG, ScoredTiles, TileStyle
from worker.benchmarks.revisit.measures import Measured, TileTable
from worker.benchmarks.revisit.visits import Revisit
from worker.simulation.truth import KINDS

TITLES = {
    "kind": "recall by kind of change",
    "case": "second visit",
    "building": "building",
    "misfit": "survey off the map, by its true poses",
    "sigma": "by the sigmas stored with the survey",
}
#: How tiles are drawn, by what a method said of them.
STYLES = {
    "hit": TileStyle(color=FOUND),
    "missed": TileStyle(color=MISSED),
    "false alarm": TileStyle(color=WRONG),
    "changed, nobody looked": TileStyle(color=MISSED, hatched=True),
    "rightly quiet": TileStyle(color="#90a4ae", alpha=0.2),
    "not observed": TileStyle(color="#eceff1", hatched=True),
}


def tables(result: Document) -> Group:
    """Show what there was to find, the methods in one table, and their recall and false alarms by groups of tiles."""
    return Group(_methods(result), _groups(result), *_notes(result["test"]))


def _methods(result: Document) -> Table:
    there = result["test"]
    title = (
        f"{there['visits']} visits, {there['without_change']} of them without a change: "
        f"{there['observed']} of {there['tiles']} tiles observed, {there['changed']['counted']} of them changed"
    )
    columns = (
        "method", "F1 (95%)", "precision", "recall", "false alarms", "quiet visits alarmed", "threshold",
        "test-optimal: F1", "threshold", "ROC area", "AP", "seconds",
    )  # fmt: skip
    chosen = result["validation"]
    caption = (
        f"thresholds: best F1 on {chosen['visits']} visits to other buildings with {chosen['changed']['counted']} "
        "changed tiles; test-optimal: best F1 on the test visits themselves"
    )
    return titled_table(title, columns, (_row(row) for row in result["methods"]), caption=caption)


def _row(row: Document) -> tuple[str, ...]:
    chosen, best = row["chosen"], row["best"]
    low, high = chosen["f1_interval"]
    return (
        row["name"],
        f"{shown(chosen['f1'], '.2f')} ({low:.2f}-{high:.2f})",
        shown(chosen["precision"], ".2f"),
        shown(chosen["recall"], ".2f"),
        shown(chosen["false_positive_rate"], ".1%"),
        f"{row['unchanged_visits_with_false_alarm']} of {row['unchanged_visits']}",
        f"{chosen['threshold']:.3g}",
        shown(best["f1"], ".2f"),
        f"{best['threshold']:.3g}",
        f"{row['area_under_roc']:.3f}",
        f"{row['average_precision']:.3f}",
        f"{row['seconds']:.1f}",
    )


def _groups(result: Document) -> Table:
    methods = result["methods"]
    table = titled_table("changes found; false alarms", ("tiles", *(row["name"] for row in methods)))
    for by, title in TITLES.items():
        table.add_section()
        table.add_row(title, style="bold")
        for group in methods[0]["groups"][by]:
            cells = [_cell(row["groups"][by][group]) for row in methods]
            if any(cells):
                table.add_row(f"  {group}", *cells)
    return table


def _cell(counts: Document) -> str:
    """Write as in `12 of 30; 1.4%`; what cannot be is left out."""
    changed = counts["true_positives"] + counts["false_negatives"]
    words = [f"{counts['true_positives']} of {changed}"] if changed else []
    if counts["false_positive_rate"] is not None:
        words.append(shown(counts["false_positive_rate"], ".1%"))
    return "; ".join(words)


def _notes(there: Document) -> list[str]:
    changed, scans = there["changed"], there["scans"]["second"]
    off = there["misfit_centimetres"]
    lines = [
        f"changed tiles that no method is asked about: {changed['unobserved']} not observed by the survey, "
        f"{changed['out_of_sight']} whose change was in no sensor's sight, {changed['outside_the_map']} where "
        "the map has too few points for a tile",
        f"scans of the second visits: {scans['accepted']} of {scans['of']} placed, "
        f"{scans['wrong']} of them over 10 cm off",
    ]
    if off is not None:
        lines.append(
            f"survey off the map by its poses: median {off['median']:.1f} cm, 95% {off['95%']:.1f} cm, "
            f"worst {off['worst']:.1f} cm"
        )
    return lines


def draw(folder: Path, methods: Sequence[Measured], table: TileTable, visits: Sequence[Revisit]) -> None:
    """Write `curves.png`, `recall.png`, and `tiles-VISIT.png` of the first method. Raises OSError."""
    plots.save(_curves(methods, table), folder / "curves.png")
    plots.save(_recall(methods), folder / "recall.png")
    number = int(np.argmax([int((visit.changed & visit.counted).sum()) for visit in visits]))
    first, visit, threshold = methods[0], visits[number], methods[0].chosen.threshold
    verdicts = verdicts_of(visit, first.scores[table.visit == number], threshold)
    title = f"{first.name} on {visit.name}: threshold {threshold:.3g}"
    plots.save(
        plots.tile_map(visit.pairs.reference, verdicts, STYLES, title), folder / f"tiles-{visit.name}.png"
    )


def _curves(methods: Sequence[Measured], table: TileTable) -> Figure:
    """Draw precision over recall, and recall over false alarms; a dot where the threshold was chosen."""
    figure = Figure(figsize=(11, 5.2), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    truth = table.changed[table.counted]
    scored = [
        ScoredTiles(
            name=method.name, scores=method.scores[table.counted], truth=truth, chosen=method.chosen.counts
        )
        for method in methods
    ]
    plots.draw_precision_recall(left, scored)
    left.axhline(truth.mean(), color=QUIET, linewidth=0.7, linestyle=":")
    plots.draw_roc(right, scored)
    for axes, title, x, y in (
        (left, "precision over recall", "recall", "precision"),
        (right, "ROC", "false alarms, share of unchanged tiles", "recall"),
    ):
        plots.entitle(axes, title)
        plots.label(axes, x, y)
    return figure


def _recall(methods: Sequence[Measured]) -> Figure:
    """Draw recall by kind of change, and by how far the survey lies off the map."""
    figure = Figure(figsize=(11, 4.6), dpi=120, layout="constrained")
    kinds, off = figure.subplots(1, 2, width_ratios=[3, 5])
    bins = [name for name, counts in methods[0].groups["misfit"].items() if counts.changed]
    _draw_recall(kinds, methods, "kind", KINDS)
    _draw_recall(off, methods, "misfit", bins)
    plots.entitle(kinds, "recall by kind of change")
    plots.entitle(off, "recall by how far the survey lies off the map")
    kinds.set_ylim(0, 1.4)  # room for the legend
    kinds.legend(fontsize=7, frameon=False, loc="upper left")
    return figure


def _draw_recall(axes: Axes, methods: Sequence[Measured], by: str, names: Sequence[str]) -> None:
    tiles = [methods[0].groups[by][name].changed for name in names]
    groups = [f"{name}\n{count} tiles" for name, count in zip(names, tiles, strict=True)]
    recall = {method.name: [method.groups[by][name].recall for name in names] for method in methods}
    plots.draw_bars(axes, groups, recall)
    plots.label(axes, "", "recall", legend=False)
    axes.set_ylim(0, 1.02)


def verdicts_of(visit: Revisit, scores: TileScore, threshold: float) -> list[str]:
    """Name what a method said of each tile: (T,) keys of STYLES."""
    flagged = scores > threshold
    verdicts: list[str] = np.where(
        visit.exists,
        np.where(~visit.counted, "changed, nobody looked", np.where(flagged, "hit", "missed")),
        np.where(~visit.counted, "not observed", np.where(flagged, "false alarm", "rightly quiet")),
    ).tolist()
    return verdicts
