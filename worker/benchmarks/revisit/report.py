"""The figures of `spicd-worker evaluate revisit` as tables on a terminal, and its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Group
from rich.table import Table

from worker.benchmarks import plots
from worker.benchmarks.documents import Document, shown, titled_table
from worker.benchmarks.plots import QUIET, ScoredTiles
from worker.benchmarks.revisit.calibration import Reliability
from worker.benchmarks.revisit.measures import Measured
from worker.benchmarks.revisit.tiles import TileTable
from worker.simulation.truth import KINDS

TITLES = {
    "kind": "recall by kind of change",
    "case": "second visit",
    "building": "building",
    "tile": "tile",
    "coverage": "points of the survey a point of the map",
    "misfit": "survey off the map, by its true poses",
}
OBJECT_TITLES = {
    "kind": "kind of change",
    "voxels": "decidable voxels",
    "size": "longest edge of the thing",
    "case": "second visit",
    "building": "building",
}


def tables(result: Document) -> Group:
    """Show what there was to find, the methods in one table, objects, groups of tiles, and the hard part by itself."""
    rows = result["methods"]
    parts = [
        _methods(result),
        _objects(rows, "objects"),
        _groups(rows),
        _object_groups(rows, "objects found"),
    ]
    hard = [row["hard"] | {"name": row["name"]} for row in rows if "hard" in row]
    if hard:
        title = _title(result["hard"], "the hard part")
        parts += [
            titled_table(title, COLUMNS, (_row(row) for row in hard)),
            _objects(hard, "objects of the hard part"),
            _object_groups(hard, "objects of the hard part found"),
        ]
    return Group(*(part for part in parts if part is not None), *_notes(result))


COLUMNS = (
    "method", "F1 (95%)", "precision", "recall", "no score", "quiet visits alarmed (tiles)", "threshold",
    "test-optimal: F1", "threshold", "ROC area", "AP", "ECE", "seconds",
)  # fmt: skip


def _methods(result: Document) -> Table:
    chosen = result["validation"]
    caption = (
        f"thresholds: best F1 on {chosen['visits']} visits to other buildings with {chosen['changed']} changed "
        "tiles; test-optimal: best F1 on the test visits themselves; no score: changed tiles that it has none for"
    )
    rows = (_row(row) for row in result["methods"])
    return titled_table(_title(result["test"], "the test"), COLUMNS, rows, caption=caption)


def _title(there: Document, name: str) -> str:
    return (
        f"{name}: {there['visits']} visits, {there['without_change']} of them without a change; "
        f"{there['changed']} changed tiles, {there['changed_and_thin_in_the_map']} of them thin in the map, "
        f"{there['unchanged']} unchanged ones, {there['left_out']} left out"
    )


def _row(row: Document) -> tuple[str, ...]:
    chosen, best, calibration = row["chosen"], row["best"], row["calibration"]["tiles"]
    low, high = chosen["f1_interval"]
    return (
        row["name"],
        f"{shown(chosen['f1'], '.3f')} ({low:.3f}-{high:.3f})",
        shown(chosen["precision"], ".3f"),
        shown(chosen["recall"], ".3f"),
        str(row["changed_without_score"]),
        f"{row['quiet_visits_with_false_alarm']} of {row['quiet_visits']} ({row['quiet_visits_with_false_tile']})",
        f"{chosen['threshold']:.3g}",
        shown(best["f1"], ".3f"),
        f"{best['threshold']:.3g}",
        f"{row['area_under_roc']:.3f}",
        f"{row['average_precision']:.3f}",
        "" if calibration is None else shown(calibration["expected_calibration_error"], ".3f"),
        f"{row['seconds']:.1f}",
    )


def _objects(rows: Sequence[Document], title: str) -> Table | None:
    told = [row for row in rows if row["objects"] is not None]
    if not told:
        return None
    columns = (
        "method", "recall (95%)", "precision (95%)", "false objects", "a quiet visit", "quiet visits with one",
        "moved, told as moved", "ECE of voxels",
    )  # fmt: skip
    regions, least = told[0]["objects"]["regions"], told[0]["objects"]["min_voxels"]
    title = f"{title}: {regions} regions of {least} decidable voxels or more"
    return titled_table(title, columns, map(_object_row, told))


def _object_row(row: Document) -> tuple[str, ...]:
    figures, calibration = row["objects"], row["calibration"]["voxels"]
    return (
        row["name"],
        _with_interval(figures["recall"], figures["recall_interval"]),
        _with_interval(figures["precision"], figures["precision_interval"]),
        f"{figures['false_objects']} of {figures['objects']}",
        shown(figures["false_objects_a_quiet_visit"], ".2f"),
        f"{figures['quiet_visits_with_an_object']} of {figures['quiet_visits']}",
        f"{shown(figures['told_as_moved'], '.2f')} of {figures['moved']}",
        "" if calibration is None else shown(calibration["expected_calibration_error"], ".4f"),
    )


def _with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    bounds = "" if interval is None else f" ({interval[0]:.3f}-{interval[1]:.3f})"
    return shown(value, ".3f") + bounds


def _groups(rows: Sequence[Document]) -> Table:
    table = titled_table("changed tiles found; false alarms", ("tiles", *(row["name"] for row in rows)))
    for by, title in TITLES.items():
        table.add_section()
        table.add_row(title, style="bold")
        for group in rows[0]["groups"][by]:
            cells = [_cell(row["groups"][by][group]) for row in rows]
            if any(cells):
                table.add_row(f"  {group}", *cells)
    return table


def _object_groups(rows: Sequence[Document], title: str) -> Table | None:
    told = [row for row in rows if row["objects"] is not None]
    if not told:
        return None
    table = titled_table(title, ("regions", *(row["name"] for row in told)))
    for by, heading in OBJECT_TITLES.items():
        table.add_section()
        table.add_row(heading, style="bold")
        for group in told[0]["objects"]["groups"][by]:
            cells = [row["objects"]["groups"][by][group] for row in told]
            if cells[0]["regions"]:
                table.add_row(f"  {group}", *(f"{cell['found']} of {cell['regions']}" for cell in cells))
    return table


def _cell(counts: Document) -> str:
    """Write as in `12 of 30; 1.4%`; what cannot be is left out."""
    changed = counts["true_positives"] + counts["false_negatives"]
    words = [f"{counts['true_positives']} of {changed}"] if changed else []
    if counts["false_positive_rate"] is not None:
        words.append(shown(counts["false_positive_rate"], ".1%"))
    return "; ".join(words)


def _notes(result: Document) -> list[str]:
    scans, off = result["test"]["scans"]["second"], result["test"]["misfit_centimetres"]
    lines = [
        f"scans of the second visits: {scans['accepted']} of {scans['of']} placed, "
        f"{scans['wrong']} of them over 10 cm off"
    ]
    if off is not None:
        lines.append(
            f"survey off the map by its poses: median {off['median']:.1f} cm, 95% {off['95%']:.1f} cm, "
            f"worst {off['worst']:.1f} cm"
        )
    return [*lines, *(f"left out: {reason}" for reason in result["left_out"])]


def draw(folder: Path, methods: Sequence[Measured], table: TileTable) -> None:
    """Write `curves.png`, `recall.png` and `reliability.png`. Raises OSError."""
    plots.save(_curves(methods, table), folder / "curves.png")
    plots.save(_recall(methods), folder / "recall.png")
    plots.save(_reliability(methods), folder / "reliability.png")


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


def _reliability(methods: Sequence[Measured]) -> Figure:
    """Draw the share that truly changed over the probability, of tiles and of voxels."""
    figure = Figure(figsize=(10, 4.8), dpi=120, layout="constrained")
    tiles, voxels = figure.subplots(1, 2)
    plots.entitle(tiles, "reliability of tiles")
    plots.entitle(voxels, "reliability of voxels")
    for color, method in plots.coloured(list(methods)):
        _draw_reliability(tiles, method.tile_reliability, color, method.name)
        _draw_reliability(voxels, method.voxel_reliability, color, method.name)
    for axes in (tiles, voxels):
        axes.plot([0, 1], [0, 1], color=QUIET, linewidth=0.7, linestyle=":")
        plots.label(axes, "probability", "share that truly changed")
    return figure


def _draw_reliability(axes: Axes, reliability: Reliability | None, color: str, name: str) -> None:
    if reliability is None:
        return
    some = reliability.counts > 0
    said, true = (part[some] / reliability.counts[some] for part in (reliability.sums, reliability.changed))
    error = shown(reliability.expected_error(), ".3f")
    axes.plot(said, true, "o-", color=color, markersize=3, label=f"{name}: error {error}")
