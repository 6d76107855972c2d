"""Figures 13 and 14: where the tiles of one experiment lie, and a change that was missed."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from worker.benchmarks.paper.benchmark import PaperResult
from worker.benchmarks.paper.embedding import outcomes_of
from worker.benchmarks.paper.figures import INK, OUTCOMES, QUIET
from worker.cloud.tiling import tile_id

PREFERRED = "magnitude_15cm"  #: of the paper's Figure 13
WORST_FIRST = ("FP", "FN", "TP", "TN")  #: of tiles above each other, the first one colours the square
MOST_POINTS = 40_000  #: drawn of a map


def tile_map(result: PaperResult) -> Figure:
    """From above; of tiles above each other the worst is shown."""
    names = [trial.experiment.name for trial in result.trials]
    place = names.index(PREFERRED) if PREFERRED in names else 0
    trial, scores = result.trials[place], result.detector.test.scores[place]
    outcome = outcomes_of(scores, trial.truth, result.detector.threshold)
    wide, deep = np.ptp(result.site.points[:, :2], axis=0)
    figure = Figure(figsize=(8, float(np.clip(8 * deep / wide + 0.8, 3, 9))), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    points = result.site.points[:: max(1, len(result.site.points) // MOST_POINTS)]
    axes.scatter(points[:, 0], points[:, 1], s=0.2, color="#9e9e9e", linewidths=0, zorder=1)
    grid, indices = result.site.tiles.grid, result.site.tiles.indices
    for column in np.unique(indices[:, :2], axis=0):
        here = outcome[(indices[:, :2] == column).all(axis=1)]
        worst = next(one for one in WORST_FIRST if (here == one).any())
        low = grid.origin[:2] + column * grid.size[:2]
        alpha = 0.15 if worst == "TN" else 0.6
        axes.add_patch(
            Rectangle(
                (float(low[0]), float(low[1])), *grid.size[:2], color=OUTCOMES[worst], alpha=alpha, zorder=2
            )
        )
    counted = ", ".join(f"{int((outcome == one).sum())} {one}" for one in ("TP", "FP", "FN", "TN"))
    axes.set_title(f"{names[place]}: {counted}", loc="left", fontsize=11, color=INK, weight="bold")
    axes.set_xlabel("x of the map (m)", fontsize=9, color=QUIET)
    axes.set_ylabel("y of the map (m)", fontsize=9, color=QUIET)
    axes.set_aspect("equal")
    return figure


def failure_case(result: PaperResult) -> Figure | None:
    """The missed tile with the highest score, a removed one where there is such; None where none was missed."""
    found = _missed(result)
    if found is None:
        return None
    place, tile, score = found
    trial = result.trials[place]
    traces = [trace for trace in trial.traces if trace.tile == tile]
    gone = np.concatenate([trace.vanished for trace in traces])
    come = np.concatenate([trace.appeared for trace in traces])
    figure = Figure(figsize=(10, 4.8), dpi=100, layout="constrained")
    index, size = result.site.tiles.indices[tile], result.site.tiles.grid.size
    corner, name = result.site.tiles.grid.lower(index), tile_id(index)
    figure.suptitle(
        f"{trial.experiment.name}, {name}: score {score:.3f}, threshold {result.detector.threshold:.2f}",
        x=0.01,
        ha="left",
        fontsize=11,
        weight="bold",
    )
    sides = (
        ("reference; red: removed from a scan", trial.pairs.reference.points[tile], gone, "#c62828"),
        ("current; green: added to a scan", trial.pairs.current[tile], come, "#2e7d32"),
    )
    for number, (title, points, marked, color) in enumerate(sides, start=1):
        axes: Any = figure.add_subplot(1, 2, number, projection="3d")
        axes.scatter(*points.T, s=4, color="#1565c0", alpha=0.6, linewidths=0)
        axes.scatter(*marked.T, s=3, color=color, alpha=0.5, linewidths=0)
        for set_limits, low, edge in zip(
            (axes.set_xlim, axes.set_ylim, axes.set_zlim), corner, size, strict=True
        ):
            set_limits(low, low + edge)
        axes.set_title(title, fontsize=9)
        axes.set_box_aspect(size)
        axes.tick_params(labelsize=6)
    return figure


def _missed(result: PaperResult) -> tuple[int, int, float] | None:
    """Trial, tile and score."""
    threshold = result.detector.threshold
    cases = [
        (trial.experiment.operation == "remove", float(scores[tile]), place, int(tile))
        for place, (trial, scores) in enumerate(zip(result.trials, result.detector.test.scores, strict=True))
        for tile in np.flatnonzero(trial.truth & (scores <= threshold))
    ]
    if not cases:
        return None
    _, score, place, tile = max(cases)
    return place, tile, score
