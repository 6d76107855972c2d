"""What one method said of one visit, layer by layer from above."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from worker.benchmarks.revisit.methods import TileScore
from worker.benchmarks.revisit.record import Revisit
from worker.cloud.types import Bools

#: What is drawn: fill, and whether it is hatched.
LOOKS = {
    "hit": ("#2e7d32", False),
    "missed": ("#ef6c00", False),
    "false alarm": ("#c62828", False),
    "changed, nobody looked": ("#ef6c00", True),
    "rightly quiet": ("#90a4ae", False),
    "not observed": ("#eceff1", True),
}
_FAINT = {"rightly quiet", "not observed"}
_MOST_POINTS = 20_000  # drawn in a layer


def draw_tile_map(visit: Revisit, scores: TileScore, *, threshold: float, title: str) -> Figure:
    """One panel a layer of tiles; points of the map in grey. `scores` (T,) are of the visit's tiles."""
    tiles = visit.pairs.reference
    layers = np.unique(tiles.indices[:, 2])
    extent = np.array(tiles.grid.shape[:2]) * tiles.grid.size[:2]
    wide = extent[0] >= extent[1]
    width, height = (6.0, 6.0 * extent[1] / extent[0]) if wide else (6.0 * extent[0] / extent[1], 6.0)
    figure = Figure(figsize=(width * len(layers) + 0.6, height + 1.4), dpi=110, layout="constrained")
    verdicts = verdicts_of(visit, scores, threshold)
    for axes, layer in zip(np.atleast_1d(figure.subplots(1, len(layers))), layers.tolist(), strict=True):
        here = tiles.indices[:, 2] == layer
        _points(axes, visit, here)
        _tiles(axes, visit, verdicts, here)
        low = tiles.grid.lower(np.array([[0, 0, layer]]))[0, 2]
        axes.set_title(f"{low:.1f} to {low + tiles.grid.size[2]:.1f} m", fontsize=9, loc="left")
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
    figure.suptitle(f"{title}: threshold {threshold:.3g}", fontsize=11, weight="bold", x=0.01, ha="left")
    figure.legend(handles=_legend(verdicts), loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return figure


def verdicts_of(visit: Revisit, scores: TileScore, threshold: float) -> list[str]:
    """(T,) keys of LOOKS."""
    flagged = scores > threshold
    return [
        _verdict(*row)
        for row in zip(flagged.tolist(), visit.exists.tolist(), visit.counted.tolist(), strict=True)
    ]


def _verdict(flagged: bool, changed: bool, counted: bool) -> str:
    if not counted:
        return "changed, nobody looked" if changed else "not observed"
    if flagged:
        return "hit" if changed else "false alarm"
    return "missed" if changed else "rightly quiet"


def _points(axes: Axes, visit: Revisit, here: Bools) -> None:
    tiles = visit.pairs.reference
    points = np.concatenate([tiles.points[at] for at in np.flatnonzero(here)])
    points = points[:: max(1, len(points) // _MOST_POINTS)]
    axes.scatter(points[:, 0], points[:, 1], s=0.15, color="#616161", linewidths=0, zorder=2, rasterized=True)


def _tiles(axes: Axes, visit: Revisit, verdicts: list[str], here: Bools) -> None:
    tiles = visit.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    for at in np.flatnonzero(here).tolist():
        color, hatched = LOOKS[verdicts[at]]
        axes.add_patch(
            Rectangle(
                (float(lower[at, 0]), float(lower[at, 1])),
                float(tiles.grid.size[0]),
                float(tiles.grid.size[1]),
                facecolor="none" if hatched else color,
                edgecolor=color if hatched else "white",
                alpha=0.2 if verdicts[at] in _FAINT and not hatched else 0.6,
                hatch="///" if hatched else None,
                linewidth=0.8,
                zorder=1,
            )
        )


def _legend(verdicts: list[str]) -> list[Patch]:
    return [
        Patch(
            facecolor="none" if hatched else color,
            edgecolor=color,
            hatch="///" if hatched else None,
            alpha=0.6,
            label=f"{name}: {verdicts.count(name)}",
        )
        for name, (color, hatched) in LOOKS.items()
    ]
