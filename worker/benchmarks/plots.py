"""The curves of a training (paper, Figure 8), from its log; training itself needs torch and NumPy alone."""

from __future__ import annotations

import csv
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from worker.training.log import LOG

CURVES = "curves.png"
TRAINING, VALIDATION = "#1565c0", "#ef6c00"

Log = list[dict[str, float]]  #: a row an epoch, columns as in `worker.training.log.EpochRow`


def draw_curves(folder: Path) -> None:
    """Write `curves.png` beside the log in the folder of a training. Raises OSError, and ValueError for another file."""
    figure = curves(read_log(folder / LOG))
    partial = folder / f"{CURVES}.partial"
    FigureCanvasAgg(figure).print_png(partial)  # type: ignore[no-untyped-call]
    partial.replace(folder / CURVES)


def curves(log: Log) -> Figure:
    """Loss on the left, accuracy on the right, of training and validation."""
    figure = Figure(figsize=(10, 4), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw(left, log, "train_loss", "validation_loss")
    left.set_ylabel("focal loss")
    left.set_ylim(bottom=0)
    _draw(right, log, "train_accuracy", "accuracy", scale=100)
    right.set_ylabel("accuracy (%)")
    right.set_ylim(0, 100)
    return figure


def read_log(path: Path) -> Log:
    """The rows of a training's log; a cell that an older log has not is left out. Raises ValueError."""
    with path.open(newline="") as file:
        rows = [{name: value for name, value in row.items() if value} for row in csv.DictReader(file)]
    return [{name: float(value) for name, value in row.items()} for row in rows]


def _draw(axes: Axes, log: Log, training: str, validation: str, *, scale: float = 1.0) -> None:
    for name, label, colour in ((training, "training", TRAINING), (validation, "validation", VALIDATION)):
        known = [row for row in log if name in row]
        epochs = [row["epoch"] for row in known]
        style = "o-" if len(known) == 1 else "-"
        axes.plot(
            epochs, [scale * row[name] for row in known], style, color=colour, label=label, linewidth=1.3
        )
    axes.set_xlabel("epoch")
    axes.grid(visible=True, linewidth=0.3)
    axes.legend(frameon=False, fontsize=8)
