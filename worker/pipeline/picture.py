"""The picture of a survey: the map from above, its tiles by state, drawn to be read at a glance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from worker.pipeline.changes import ChangeSet, TileState
from worker.pipeline.export import STATE_COLORS
from worker.pipeline.mapping import CurrentMap
from worker.pipeline.values import Points

_PIXEL = 0.05  # metres
_INK = "#222222"
#: of the tiles in one column of the grid, the one that is shown; the rest would lie under it
_PRECEDENCE = (TileState.CHANGED, TileState.INCONSISTENT, TileState.UNOBSERVED, TileState.UNCHANGED)
_FILL = {
    TileState.CHANGED: 0.45,
    TileState.INCONSISTENT: 0.4,
    TileState.UNOBSERVED: 0.16,
    TileState.UNCHANGED: 0.0,
}
#: a second sign beside the colour, for eyes and printers without it
_HATCH = {
    TileState.CHANGED: "",
    TileState.INCONSISTENT: "xx",
    TileState.UNOBSERVED: "//",
    TileState.UNCHANGED: "",
}


def draw_picture(
    path: Path, reference: Points, current: CurrentMap, changes: ChangeSet, *, title: str
) -> None:
    """Write a PNG: the reference (M, 3) in grey, what only the survey saw in ink, the tiles by state.

    Map frame, metres, x to the right and y up; ceilings are cut away. Raises OSError.
    """
    extent = _extent(changes)
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    scale = min(11.0 / width, 9.0 / height)
    figure = Figure(
        figsize=(max(width * scale, 6.5) + 0.6, height * scale + 1.9), dpi=130, layout="constrained"
    )
    axes = figure.add_subplot()
    _draw_walls(axes, reference, current.points, extent)
    _draw_tiles(axes, changes)
    _draw_scale_bar(axes, extent)
    _dress(figure, axes, extent, changes, title)
    aside = path.with_name(path.name + ".tmp")
    FigureCanvasAgg(figure)
    figure.savefig(aside, format="png")
    aside.replace(path)


def _extent(changes: ChangeSet) -> tuple[float, float, float, float]:
    """left, right, bottom, top in metres: all tiles, and half a metre around."""
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    left, bottom = lower[:, :2].min(axis=0) - 0.5
    right, top = (lower + tiles.grid.size)[:, :2].max(axis=0) + 0.5
    return float(left), float(right), float(bottom), float(top)


def _draw_walls(
    axes: Axes, reference: Points, current: Points, extent: tuple[float, float, float, float]
) -> None:
    """How much stands above each spot between knee and head, so that furniture and walls show."""
    floor = float(np.percentile(reference[:, 2], 1))
    before, now = (_standing(points, floor, extent) for points in (reference, current))
    shade = np.clip(before / 12.0, 0, 1) * 0.75
    picture = np.repeat(1 - shade[:, :, None], 3, axis=2)
    only_now = (now > 2) & ~_near(before > 0)
    picture[only_now] = (0.1, 0.1, 0.1)
    axes.imshow(picture, origin="lower", extent=extent, interpolation="nearest", zorder=0)


def _standing(points: Points, floor: float, extent: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """(rows, columns) voxels from 15 cm to 2 m above the floor in each pixel."""
    body = points[(points[:, 2] > floor + 0.15) & (points[:, 2] < floor + 2.0)]
    left, right, bottom, top = extent
    bins = [round((top - bottom) / _PIXEL), round((right - left) / _PIXEL)]
    counts, _, _ = np.histogram2d(body[:, 1], body[:, 0], bins=bins, range=[[bottom, top], [left, right]])
    return np.asarray(counts, np.float64)


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Grown by two pixels, 10 cm: noise at a wall is not news."""
    grown = mask.copy()
    for axis in (0, 1):
        for shift in (-2, -1, 1, 2):
            grown |= np.roll(mask, shift, axis=axis)
    return grown


def _draw_tiles(axes: Axes, changes: ChangeSet) -> None:
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    shown: dict[tuple[int, int], int] = {}
    for row, (i, j, _) in enumerate(tiles.indices):
        key, state = (int(i), int(j)), TileState(int(changes.states[row]))
        if key not in shown or _rank(state) < _rank(TileState(int(changes.states[shown[key]]))):
            shown[key] = row
    for row in shown.values():
        state = TileState(int(changes.states[row]))
        color = tuple(channel / 255 for channel in STATE_COLORS[state])
        marked = state is not TileState.UNCHANGED
        axes.add_patch(
            Rectangle(
                (lower[row, 0], lower[row, 1]),
                float(tiles.grid.size[0]),
                float(tiles.grid.size[1]),
                facecolor=(*color, _FILL[state]),
                edgecolor=color if marked else (0.6, 0.6, 0.6, 0.35),
                linewidth=1.6 if state is TileState.CHANGED else 0.6,
                hatch=_HATCH[state],
                zorder=3 if state is TileState.CHANGED else 2,
            )
        )
        if state is TileState.CHANGED:
            center = lower[row] + tiles.grid.size / 2
            score = f"{changes.probabilities[row, 1]:.2f}"
            axes.text(center[0], center[1], score, ha="center", va="center", fontsize=8, color=_INK, zorder=4)


def _rank(state: TileState) -> int:
    return _PRECEDENCE.index(state)


def _draw_scale_bar(axes: Axes, extent: tuple[float, float, float, float]) -> None:
    left, right, bottom, _ = extent
    length = next(size for size in (20.0, 10.0, 5.0, 2.0, 1.0, 0.5) if size <= max((right - left) / 4, 0.5))
    x, y = left + 0.25, bottom + 0.18
    axes.plot([x, x + length], [y, y], color=_INK, linewidth=3, solid_capstyle="butt", zorder=5)
    axes.text(
        x + length / 2, y + 0.06, f"{length:g} m", ha="center", va="bottom", fontsize=8, color=_INK, zorder=5
    )


def _dress(
    figure: Figure, axes: Axes, extent: tuple[float, float, float, float], changes: ChangeSet, title: str
) -> None:
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7, colors="#666666")
    axes.set_xlabel("x of the map, m", fontsize=8, color="#666666")
    axes.set_ylabel("y of the map, m", fontsize=8, color="#666666")
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title(title, loc="left", fontsize=11, color=_INK)
    counts = changes.counts()
    entries = [_legend_entry(state, counts[state.label]) for state in _PRECEDENCE]
    entries.append(Patch(facecolor=(0.1, 0.1, 0.1), label="seen in the survey only"))
    figure.legend(handles=entries, loc="outside lower center", ncols=5, fontsize=8, frameon=False)


def _legend_entry(state: TileState, count: int) -> Patch:
    red, green, blue = (channel / 255 for channel in STATE_COLORS[state])
    return Patch(
        facecolor=(red, green, blue, max(_FILL[state], 0.05)),
        edgecolor=(red, green, blue),
        hatch=_HATCH[state],
        label=f"{count} {state.label}",
    )
