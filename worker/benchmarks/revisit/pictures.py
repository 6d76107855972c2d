"""Pictures of the benchmark: curves of all methods, recall by kind, and what one method said of one visit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from worker.benchmarks.revisit.measures import Measured
from worker.benchmarks.revisit.record import Revisit
from worker.benchmarks.revisit.tile_map import draw_tile_map
from worker.benchmarks.revisit.tile_table import TileTable
from worker.metrics import precision_recall, roc
from worker.simulation.truth import KINDS

COLORS = ("#1565c0", "#ef6c00", "#2e7d32", "#6a1b9a", "#00838f", "#5d4037", "#c2185b")
INK = "#1a1a1a"


def draw(folder: Path, methods: Sequence[Measured], table: TileTable, visits: Sequence[Revisit]) -> None:
    """Write `curves.png`, `recall.png`, and `tiles-VISIT.png` of the first method. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    _save(_curves(methods, table), folder / "curves.png")
    _save(_recall(methods), folder / "recall.png")
    number = int(np.argmax([int((visit.changed & visit.counted).sum()) for visit in visits]))
    first, visit = methods[0], visits[number]
    figure = draw_tile_map(
        visit,
        first.scores[table.visit == number],
        threshold=first.chosen.threshold,
        title=f"{first.name} on {visit.name}",
    )
    _save(figure, folder / f"tiles-{visit.name}.png")


def _curves(methods: Sequence[Measured], table: TileTable) -> Figure:
    """Precision over recall, and recall over false alarms; a dot where the threshold was chosen."""
    figure = Figure(figsize=(11, 5.2), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    truth = table.changed[table.counted]
    for color, method in _coloured(methods):
        scores, at = method.scores[table.counted], method.chosen.counts
        curve, rates = precision_recall(scores, truth), roc(scores, truth)
        name = f"{method.name}, AP {method.average_precision:.2f}, ROC {method.roc_area:.2f}"
        left.step(curve.recall, curve.precision, where="post", color=color, linewidth=1.4, label=name)
        left.plot(at.recall, at.precision, "o", color=color)
        right.plot(rates.false_positive_rate, rates.recall, color=color, linewidth=1.4)
        right.plot(at.false_positive_rate, at.recall, "o", color=color)
    right.plot([0, 1], [0, 1], color="#bbbbbb", linewidth=0.8, linestyle=":")
    left.axhline(truth.mean(), color="#bbbbbb", linewidth=0.8, linestyle=":")
    _named(left, "precision over recall", "recall", "precision")
    _named(right, "ROC", "false alarms, share of unchanged tiles", "recall")
    for axes in (left, right):
        axes.set_xlim(-0.02, 1.02)
        axes.set_ylim(-0.02, 1.02)
        axes.grid(color="#eeeeee")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return figure


def _recall(methods: Sequence[Measured]) -> Figure:
    """Recall by kind of change; recall and false alarms by how far the survey lies off the map."""
    figure = Figure(figsize=(11, 4.6), dpi=120, layout="constrained")
    kinds, off = figure.subplots(1, 2, width_ratios=[3, 5])
    _bars(kinds, methods, "kind", KINDS, lambda counts: counts.recall)
    _named(kinds, "recall by kind of change", "", "recall")
    bins = [name for name, counts in methods[0].groups["misfit"].items() if counts.changed]
    _bars(off, methods, "misfit", bins, lambda counts: counts.recall)
    _named(off, "recall by how far the survey lies off the map", "", "recall")
    kinds.legend(fontsize=7, frameon=False, loc="upper left")
    return figure


def _bars(axes: Axes, methods: Sequence[Measured], by: str, names: Sequence[str], value: Any) -> None:
    width = 0.8 / len(methods)
    for number, (color, method) in enumerate(_coloured(methods)):
        counts = [method.groups[by][name] for name in names]
        places = np.arange(len(names)) + (number - (len(methods) - 1) / 2) * width
        axes.bar(
            places, [np.nan_to_num(value(each)) for each in counts], width, color=color, label=method.name
        )
    tiles = [methods[0].groups[by][name].changed for name in names]
    labels = [f"{name}\n{count} tiles" for name, count in zip(names, tiles, strict=True)]
    axes.set_xticks(np.arange(len(names)), labels, fontsize=8)
    axes.set_ylim(0, 1.4 if by == "kind" else 1.02)  # room for the legend


def _coloured(methods: Sequence[Measured]) -> list[tuple[str, Measured]]:
    return [(COLORS[number % len(COLORS)], method) for number, method in enumerate(methods)]


def _named(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, color=INK, weight="bold")
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.tick_params(labelsize=8)


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure).print_png(str(path))  # type: ignore[no-untyped-call]
