"""Pictures that several benchmarks draw, in one style: curves, bars, tiles from above, a training's curves."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import ArrayLike

from worker.benchmarks.documents import write_bytes
from worker.cloud.tiling import Tiles
from worker.cloud.types import Bools, Floats, Points
from worker.metrics import Confusion, Scores, precision_recall, roc
from worker.training.log import LOG

INK, QUIET, GRID = "#1a1a1a", "#666666", "#eeeeee"
COLORS = ("#1565c0", "#ef6c00", "#2e7d32", "#6a1b9a", "#00838f", "#5d4037", "#c2185b")
FOUND, MISSED, WRONG = "#2e7d32", "#ef6c00", "#c62828"
PIXEL, BEYOND = 0.05, 0.5  #: metres: of a plan's pixel, and that a plan reaches beyond its points

CURVES = "curves.png"
Item = TypeVar("Item")
Log = list[dict[str, float]]  #: a row an epoch, columns as in `worker.training.log.EpochRow`


def single(title: str) -> tuple[Figure, Axes]:
    """Return a figure with one plot and its title."""
    figure = Figure(figsize=(7, 4.2), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    entitle(axes, title)
    return figure, axes


def entitle(axes: Axes, title: str) -> None:
    """Put the title over a plot."""
    axes.set_title(title, loc="left", fontsize=11, color=INK, weight="bold")


def label(axes: Axes, x: str, y: str, *, legend: bool = True) -> None:
    """Name both axes, and what the legend has to name."""
    axes.set_xlabel(x, fontsize=9, color=QUIET)
    axes.set_ylabel(y, fontsize=9, color=QUIET)
    axes.tick_params(labelsize=8, colors=QUIET)
    axes.grid(color=GRID)
    axes.set_axisbelow(True)
    if legend:
        axes.legend(fontsize=8, frameon=False)


def png(figure: Figure) -> bytes:
    """Return the figure as PNG."""
    into = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(into, format="png")
    return into.getvalue()


def save(figure: Figure, path: Path) -> None:
    """Write the figure as PNG, aside and renamed. Raises OSError."""
    write_bytes(path, png(figure))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ScoredTiles:
    """What one method said of N tiles."""

    name: str
    scores: Scores  #: (N,)
    truth: Bools  #: (N,)
    chosen: Confusion | None = None  #: at the threshold that was chosen; a dot on the curves


def draw_precision_recall(axes: Axes, methods: Sequence[ScoredTiles]) -> None:
    """Draw precision over recall, one curve a method; the area under it is the average precision."""
    for color, method in coloured(methods):
        curve = precision_recall(method.scores, method.truth)
        name = f"{method.name}: average precision {curve.average_precision:.2f}"
        axes.step(curve.recall, curve.precision, where="pre", color=color, label=name)
        if method.chosen is not None:
            axes.plot(method.chosen.recall, method.chosen.precision, "o", color=color)
    axes.set_xlim(-0.02, 1.02)
    axes.set_ylim(-0.02, 1.03)


def draw_roc(axes: Axes, methods: Sequence[ScoredTiles]) -> None:
    """Draw the receiver operating characteristic, one curve a method."""
    for color, method in coloured(methods):
        curve = roc(method.scores, method.truth)
        name = f"{method.name}: area {curve.area:.2f}"
        axes.plot(curve.false_positive_rate, curve.recall, color=color, label=name)
        if method.chosen is not None:
            axes.plot(method.chosen.false_positive_rate, method.chosen.recall, "o", color=color)
    axes.plot([0, 1], [0, 1], color=QUIET, linewidth=0.7, linestyle=":")
    axes.set_xlim(-0.02, 1.02)
    axes.set_ylim(-0.02, 1.03)


def draw_bars(axes: Axes, groups: Sequence[str], series: Mapping[str, ArrayLike]) -> None:
    """Draw bars side by side in each group, a colour a series; NaN has no height."""
    width = 0.8 / len(series)
    for number, (color, (name, values)) in enumerate(coloured(list(series.items()))):
        places = np.arange(len(groups)) + (number - (len(series) - 1) / 2) * width
        axes.bar(places, np.nan_to_num(np.array(values, np.float64)), width, color=color, label=name)
    axes.set_xticks(np.arange(len(groups)), groups, fontsize=8)


def coloured(items: Sequence[Item]) -> list[tuple[str, Item]]:
    """Give each item its colour."""
    return [(COLORS[number % len(COLORS)], item) for number, item in enumerate(items)]


def draw_plan(axes: Axes, points: Points) -> None:
    """Draw points (N, 3) from above as a grey plan, darker where more of them stand over each other."""
    low, high = points[:, :2].min(axis=0) - BEYOND, points[:, :2].max(axis=0) + BEYOND
    bins = np.ceil((high - low) / PIXEL).astype(int)
    counts, _, _ = np.histogram2d(
        points[:, 1], points[:, 0], bins=bins[::-1].tolist(), range=[[low[1], high[1]], [low[0], high[0]]]
    )
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    axes.imshow(
        1 - 0.5 * np.clip(counts / 12, 0, 1),
        cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, zorder=0,
    )  # fmt: skip
    axes.set_xlabel("x of the map (m)", fontsize=8, color=QUIET)
    axes.set_ylabel("y of the map (m)", fontsize=8, color=QUIET)
    axes.tick_params(labelsize=7, colors=QUIET)
    axes.set_aspect("equal")


@dataclass(frozen=True, kw_only=True, slots=True)
class TileStyle:
    """How a tile with one verdict is drawn."""

    color: str
    hatched: bool = False
    alpha: float = 0.6


def tile_map(tiles: Tiles, verdicts: Sequence[str], styles: Mapping[str, TileStyle], title: str) -> Figure:
    """Draw the tiles from above, one panel a layer, coloured by `verdicts` (T,), which are keys of `styles`."""
    layers = np.unique(tiles.indices[:, 2])
    lower, size = tiles.grid.lower(tiles.indices), tiles.grid.size
    width, height = _panel(lower, size)
    figure = Figure(figsize=(width * len(layers) + 0.6, height + 1.4), dpi=110, layout="constrained")
    for axes, layer in zip(np.atleast_1d(figure.subplots(1, len(layers))), layers.tolist(), strict=True):
        chosen = np.flatnonzero(tiles.indices[:, 2] == layer).tolist()
        draw_plan(axes, np.concatenate([tiles.points[tile] for tile in chosen]))
        for tile in chosen:
            axes.add_patch(_square(lower[tile], size, styles[verdicts[tile]]))
        low = lower[chosen[0], 2]
        axes.set_title(f"{low:.1f} to {low + size[2]:.1f} m", fontsize=9, loc="left")
        axes.set_xlim(lower[:, 0].min() - BEYOND, lower[:, 0].max() + size[0] + BEYOND)
        axes.set_ylim(lower[:, 1].min() - BEYOND, lower[:, 1].max() + size[1] + BEYOND)
    figure.suptitle(title, fontsize=11, weight="bold", x=0.01, ha="left")
    handles = [
        _square(np.zeros(2), size, style, name=f"{name}: {verdicts.count(name)}")
        for name, style in styles.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return figure


def _panel(lower: Floats, size: Floats) -> tuple[float, float]:
    """Return the width and height of a layer's panel in inches, the longer side 6."""
    wide, deep = (lower.max(axis=0) + size - lower.min(axis=0))[:2]
    return (6.0, float(6 * deep / wide)) if wide >= deep else (float(6 * wide / deep), 6.0)


def _square(corner: Floats, size: Floats, style: TileStyle, *, name: str = "") -> Patch:
    return Rectangle(
        (float(corner[0]), float(corner[1])),
        float(size[0]),
        float(size[1]),
        facecolor="none" if style.hatched else style.color,
        edgecolor=style.color if style.hatched else "white",
        alpha=style.alpha,
        hatch="///" if style.hatched else None,
        linewidth=0.8,
        zorder=1,
        label=name,
    )


def draw_curves(folder: Path) -> None:
    """Write `curves.png` beside the log of a training. Raises OSError, and ValueError for another file."""
    save(training_curves(read_log(folder / LOG)), folder / CURVES)


def training_curves(log: Log) -> Figure:
    """Draw loss and accuracy of training and validation over the epochs (paper, Figure 8)."""
    figure = Figure(figsize=(10, 4), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_losses(left, log)
    label(left, "epoch", "focal loss")
    left.set_ylim(bottom=0)
    _draw_epochs(right, log, "train_accuracy", "accuracy", scale=100)
    label(right, "epoch", "accuracy (%)")
    right.set_ylim(0, 100)
    return figure


def draw_losses(axes: Axes, log: Log) -> None:
    """Draw the loss of training and validation over the epochs."""
    _draw_epochs(axes, log, "train_loss", "validation_loss")


def read_log(path: Path) -> Log:
    """Read the rows of a training's log; a cell that an older log has not is left out. Raises ValueError."""
    with path.open(newline="") as file:
        rows = [{name: value for name, value in row.items() if value} for row in csv.DictReader(file)]
    return [{name: float(value) for name, value in row.items()} for row in rows]


def _draw_epochs(axes: Axes, log: Log, training: str, validation: str, *, scale: float = 1.0) -> None:
    for color, (column, name) in coloured([(training, "training"), (validation, "validation")]):
        known = [row for row in log if column in row]
        style = "o-" if len(known) == 1 else "-"
        values = [scale * row[column] for row in known]
        axes.plot([row["epoch"] for row in known], values, style, color=color, label=name, linewidth=1.3)
