"""`spicd-worker evaluate table`, in pictures: what the cards say of each experiment, of disturbances and of training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from worker.benchmarks.paper.experiments import published
from worker.benchmarks.plots import coloured, draw_losses, entitle, label, read_log, save
from worker.benchmarks.table import Measured

PRINTED = "#555"  #: of points that the paper prints


def write_pictures(folder: Path, rows: Sequence[Measured], model_store: Path) -> list[Path]:
    """Write `comparison-*.png` of whatever was measured; returns them. Raises OSError, and ValueError for odd logs."""
    figures = {
        "experiments": experiments(rows),
        "disturbances": disturbances(rows),
        "training": training(rows, model_store),
    }
    folder.mkdir(parents=True, exist_ok=True)
    paths = {folder / f"comparison-{name}.png": figure for name, figure in figures.items() if figure}
    for path, figure in paths.items():
        save(figure, path)
    return list(paths)


def experiments(rows: Sequence[Measured]) -> Figure | None:
    """Draw the F1 of each of the paper's experiments, its own beside it; None where no card has any."""
    told = [(row.name, row.sections.get("paper", {}).get("f1_by_experiment")) for row in rows]
    known = [(name, by_experiment) for name, by_experiment in told if by_experiment]
    if not known:
        return None
    printed = published()["table_5"]
    names = [name for name in printed if any(name in by_experiment for _, by_experiment in known)]
    figure = Figure(figsize=(10, 4.6), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    for color, (model, by_experiment) in coloured(known):
        values = [_drawn(by_experiment.get(name)) for name in names]
        axes.plot(names, values, "o-", color=color, label=model)
    theirs = [printed[name]["f1"] for name in names]
    axes.plot(names, theirs, "D", color=PRINTED, label="SPICD-Net in the paper")
    entitle(axes, "The paper's experiments: F1 at a threshold chosen on another corridor")
    label(axes, "", "F1", legend=False)
    axes.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    axes.set_ylim(-0.03, 1.03)
    axes.tick_params(axis="x", rotation=35)
    return figure


def disturbances(rows: Sequence[Measured]) -> Figure | None:
    """Draw F1 under noise, lost points and wrong registration; None where no card has them."""
    told = [(row.name, row.sections.get("paper", {}).get("robustness")) for row in rows]
    known = [(name, points) for name, points in told if points]
    if not known:
        return None
    kinds = list(dict.fromkeys(point["disturbance"] for _, points in known for point in points))
    figure = Figure(figsize=(10, 3.2 * ((len(kinds) + 1) // 2)), dpi=100, layout="constrained")
    for place, kind in enumerate(kinds, start=1):
        axes = figure.add_subplot((len(kinds) + 1) // 2, 2, place)
        for color, (model, points) in coloured(known):
            here = [point for point in points if point["disturbance"] == kind]
            values = [_drawn(point["f1"]) for point in here]
            axes.plot(
                [point["level"] for point in here], values, "o-", markersize=3, color=color, label=model
            )
        if kind.startswith("dropout"):
            paper = published()["robustness"]["dropout"]
            lost = [100 * float(share) for share in paper]
            axes.plot(lost, list(paper.values()), "D", color=PRINTED, label="paper")
        axes.set_ylim(-0.03, 1.03)
        label(axes, kind, "F1", legend=False)
    named = {str(line.get_label()): line for axes in figure.axes for line in axes.lines}
    figure.legend(list(named.values()), list(named), loc="outside right center", fontsize=8, frameon=False)
    return figure


def _drawn(value: float | None) -> float:
    return float("nan") if value is None else value


def training(rows: Sequence[Measured], model_store: Path) -> Figure | None:
    """Draw the losses of each training whose log lies beside the card; None where none does."""
    logs = [
        (f"{row.name}, {log.stem.replace('_', ' ').replace('-', ' ')}", read_log(log))
        for row in rows
        for log in sorted((model_store / row.name).glob("*epochs*.csv"))
    ]
    if not logs:
        return None
    down = (len(logs) + 2) // 3
    figure = Figure(figsize=(10, 2.8 * down), dpi=100, layout="constrained")
    for place, (name, log) in enumerate(logs, start=1):
        axes = figure.add_subplot(down, 3, place)
        draw_losses(axes, log)
        entitle(axes, name)
        label(axes, "epoch", "loss")
        axes.set_ylim(bottom=0)
    return figure
