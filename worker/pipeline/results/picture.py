"""The picture of a survey: the map from above, its tiles by state, title, scale bar and legend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from worker.cloud.types import Points
from worker.files import write_atomically
from worker.pipeline.mapping.fusion import CurrentMap
from worker.pipeline.results.changes import ChangeSet, TileState
from worker.pipeline.results.export import STATE_COLORS

Extent = tuple[float, float, float, float]  #: left, right, bottom, top; metres, map frame

INK = "#1a1a1a"
QUIET = "#666666"
#: How strongly a tile is filled, and a second sign beside the colour, for eyes and printers without it. Of the tiles
#: in one column of the grid the first in this order is shown; the rest would lie under it.
STYLES = {
    TileState.CHANGED: (0.4, ""),
    TileState.INCONSISTENT: (0.3, "xx"),
    TileState.UNOBSERVED: (0.1, "//"),
    TileState.UNCHANGED: (0.0, ""),
}
PRECEDENCE = tuple(STYLES)
HATCH_WIDTH = 0.5  # points
HEAD, FOOT, SIDE = 0.75, 1.0, 0.55  # inches above, below and left of it


def draw_scale_bar(figure: Figure, extent: Extent, scale: float) -> None:
    """Draw a scale bar at the head, on the right; `scale` is inches a metre."""
    wide, high = figure.get_size_inches()
    longest = max((extent[1] - extent[0]) / 4, 0.5)
    length = next(size for size in (20.0, 10.0, 5.0, 2.0, 1.0, 0.5) if size <= longest)
    right, y = 1 - SIDE / wide, 1 - 0.6 / high
    left = right - length * scale / wide
    figure.add_artist(Line2D((left, right), (y, y), color=INK, linewidth=3, solid_capstyle="butt"))
    figure.text((left + right) / 2, y + 0.06 / high, f"{length:g} m", ha="center", fontsize=8, color=INK)


def dress(figure: Figure, axes: Axes, extent: Extent, changes: ChangeSet, title: str) -> None:
    """Write axes, title and counts at the head, the legend at the foot."""
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])
    axes.tick_params(labelsize=7, colors=QUIET, length=2)
    axes.set_xlabel("x of the map (m)", fontsize=8, color=QUIET)
    axes.set_ylabel("y of the map (m)", fontsize=8, color=QUIET)
    for spine in axes.spines.values():
        spine.set_visible(False)
    counts = changes.counts()
    said = f"{counts['changed']} of {len(changes.states)} tiles changed, at a score above {changes.threshold:.2f}"
    above, left = figure.get_figheight(), SIDE / figure.get_figwidth()
    figure.text(left, 1 - 0.3 / above, title, fontsize=12, color=INK, va="center", weight="bold")
    figure.text(left, 1 - 0.55 / above, said, fontsize=9, color=QUIET, va="center")
    entries = [_legend_entry(state, counts[state.label]) for state in PRECEDENCE]
    entries.append(Patch(facecolor=INK, label="seen in the survey only"))
    figure.legend(
        handles=entries,
        loc="lower center",
        bbox_to_anchor=(0.5, 0.2 / above),
        ncols=5,
        fontsize=8,
        frameon=False,
    )
    note = (
        "seen from above, between 0.15 and 2 m over the floor; "
        "of tiles above each other the first in this list is drawn"
    )
    figure.text(0.5, 0.14 / above, note, fontsize=6.5, color=QUIET, ha="center", va="center")


def _legend_entry(state: TileState, count: int) -> Patch:
    color, (fill, hatch) = color_of(state), STYLES[state]
    return Patch(
        facecolor=(*color, max(fill, 0.05)),
        edgecolor=color,
        hatch=hatch,
        label=f"{count} {state.label}",
    )


def color_of(state: TileState) -> tuple[float, float, float]:
    """Return red, green, blue, 0..1."""
    red, green, blue = (channel / 255 for channel in STATE_COLORS[state])
    return red, green, blue


_PIXEL = 0.05  # metres, or more where the picture would have too many
_MOST_PIXELS = 4000  # along a side
_DARKEST_WALL = 0.5  # grey of the map, so that ink on it is seen at once
_ROOM_FOR_ID = 0.75  # inches; a smaller tile shows its score alone
_WIDEST, _HIGHEST, _NARROWEST = 11.0, 9.0, 6.5  # inches of the map's part of the picture


def draw_picture(
    path: Path, reference: Points, current: CurrentMap, changes: ChangeSet, *, title: str
) -> None:
    """Write a PNG: the reference (M, 3) in grey, what only the survey saw in ink, the tiles by state.

    Map frame, metres, x to the right and y up; ceilings are cut away. Raises OSError.
    """
    extent = _extent(changes)
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    scale = min(_WIDEST / width, _HIGHEST / height)  # inches a metre
    sheet = (max(width * scale, _NARROWEST) + 2 * SIDE, height * scale + HEAD + FOOT)
    figure = Figure(figsize=sheet, dpi=130, facecolor="white")
    FigureCanvasAgg(figure)
    place = (0.5 - width * scale / sheet[0] / 2, FOOT / sheet[1])
    axes = figure.add_axes((*place, width * scale / sheet[0], height * scale / sheet[1]))
    _draw_walls(axes, reference, current.points, extent)
    _draw_tiles(axes, changes, tile_inches=float(changes.pairs.reference.grid.size[0]) * scale)
    draw_scale_bar(figure, extent, scale)
    dress(figure, axes, extent, changes, title)
    with rc_context({"hatch.linewidth": HATCH_WIDTH}):
        write_atomically(path, lambda aside: figure.savefig(aside, format="png"))


def _extent(changes: ChangeSet) -> Extent:
    """Return left, right, bottom, top in metres: all tiles, and half a metre around."""
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    left, bottom = lower[:, :2].min(axis=0) - 0.5
    right, top = (lower + tiles.grid.size)[:, :2].max(axis=0) + 0.5
    return float(left), float(right), float(bottom), float(top)


def _draw_walls(axes: Axes, reference: Points, current: Points, extent: Extent) -> None:
    """Draw how much stands above each spot between knee and head, so that furniture and walls show."""
    floor = float(np.percentile(reference[:, 2], 1))
    before, now = (_standing(points, floor, extent) for points in (reference, current))
    shade = np.clip(before / 12.0, 0, 1) * _DARKEST_WALL
    picture = np.repeat(1 - shade[:, :, None], 3, axis=2)
    only_now = (now > 2) & ~_near(before > 0)
    picture[only_now] = to_rgb(INK)
    axes.imshow(picture, origin="lower", extent=extent, interpolation="antialiased", zorder=0)


def _standing(points: Points, floor: float, extent: Extent) -> NDArray[np.float64]:
    """Return (rows, columns) voxels from 15 cm to 2 m above the floor in each pixel."""
    body = points[(points[:, 2] > floor + 0.15) & (points[:, 2] < floor + 2.0)]
    left, right, bottom, top = extent
    pixel = max(_PIXEL, (top - bottom) / _MOST_PIXELS, (right - left) / _MOST_PIXELS)
    bins = [round((top - bottom) / pixel), round((right - left) / pixel)]
    counts, _, _ = np.histogram2d(body[:, 1], body[:, 0], bins=bins, range=[[bottom, top], [left, right]])
    return np.asarray(counts, np.float64)


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Grow the mask by two pixels, 10 cm: noise at a wall is no change."""
    grown = mask.copy()
    for axis in (0, 1):
        for shift in (-2, -1, 1, 2):
            grown |= np.roll(mask, shift, axis=axis)
    return grown


def _draw_tiles(axes: Axes, changes: ChangeSet, *, tile_inches: float) -> None:
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    for row in _topmost(changes):
        state = TileState(int(changes.states[row]))
        color, (fill, hatch) = color_of(state), STYLES[state]
        axes.add_patch(
            Rectangle(
                (lower[row, 0], lower[row, 1]),
                float(tiles.grid.size[0]),
                float(tiles.grid.size[1]),
                facecolor=(*color, fill),
                edgecolor=(0.6, 0.6, 0.6, 0.35) if state is TileState.UNCHANGED else color,
                linewidth=2.0 if state is TileState.CHANGED else 0.6,
                hatch=hatch,
                zorder=3 if state is TileState.CHANGED else 2,
            )
        )
        if state is TileState.CHANGED:
            _label(axes, changes, row, with_id=tile_inches >= _ROOM_FOR_ID)


def _topmost(changes: ChangeSet) -> list[int]:
    """Return of each column of the grid the row of the tile that is shown: by precedence, then by score."""
    shown: dict[tuple[int, int], int] = {}
    for row in sorted(range(len(changes.states)), key=lambda row: _order(changes, row)):
        i, j, _ = changes.pairs.reference.indices[row]
        shown.setdefault((int(i), int(j)), row)
    return list(shown.values())


def _order(changes: ChangeSet, row: int) -> tuple[int, float]:
    score = float(np.nan_to_num(changes.scores[row]))
    return PRECEDENCE.index(TileState(int(changes.states[row]))), -score


def _label(axes: Axes, changes: ChangeSet, row: int, *, with_id: bool) -> None:
    """Write in a corner of the tile, off what stands in it: the score, and the numbers of the id that tables name."""
    tiles = changes.pairs.reference
    index = tiles.indices[row]
    x, y = tiles.grid.lower(index)[0], tiles.grid.lower(index)[1] + tiles.grid.size[1]
    lines = [(f"{changes.scores[row]:.2f}", 9 if with_id else 7, 4.0)]
    if with_id:
        lines.append(("_".join(f"{number:03d}" for number in index), 6, 14.0))
    for text, size, down in lines:
        axes.annotate(
            text,
            (float(x), float(y)),
            xytext=(4.0, -down),
            textcoords="offset points",
            va="top",
            fontsize=size,
            color=INK,
            zorder=4,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
        )
