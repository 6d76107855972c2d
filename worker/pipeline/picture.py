"""The picture of a survey: the map from above, its tiles by state, drawn to be read at a glance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from worker.pipeline.changes import ChangeSet, TileState
from worker.pipeline.mapping import CurrentMap
from worker.pipeline.picture_frame import (
    FILL,
    FOOT,
    HATCH,
    HATCH_WIDTH,
    HEAD,
    INK,
    PRECEDENCE,
    SIDE,
    Extent,
    color_of,
    draw_scale_bar,
    dress,
)
from worker.pipeline.values import Points

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
    aside = path.with_name(path.name + ".tmp")
    with rc_context({"hatch.linewidth": HATCH_WIDTH}):
        figure.savefig(aside, format="png")
    aside.replace(path)


def _extent(changes: ChangeSet) -> Extent:
    """left, right, bottom, top in metres: all tiles, and half a metre around."""
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    left, bottom = lower[:, :2].min(axis=0) - 0.5
    right, top = (lower + tiles.grid.size)[:, :2].max(axis=0) + 0.5
    return float(left), float(right), float(bottom), float(top)


def _draw_walls(axes: Axes, reference: Points, current: Points, extent: Extent) -> None:
    """How much stands above each spot between knee and head, so that furniture and walls show."""
    floor = float(np.percentile(reference[:, 2], 1))
    before, now = (_standing(points, floor, extent) for points in (reference, current))
    shade = np.clip(before / 12.0, 0, 1) * _DARKEST_WALL
    picture = np.repeat(1 - shade[:, :, None], 3, axis=2)
    only_now = (now > 2) & ~_near(before > 0)
    picture[only_now] = to_rgb(INK)
    axes.imshow(picture, origin="lower", extent=extent, interpolation="antialiased", zorder=0)


def _standing(points: Points, floor: float, extent: Extent) -> NDArray[np.float64]:
    """(rows, columns) voxels from 15 cm to 2 m above the floor in each pixel."""
    body = points[(points[:, 2] > floor + 0.15) & (points[:, 2] < floor + 2.0)]
    left, right, bottom, top = extent
    pixel = max(_PIXEL, (top - bottom) / _MOST_PIXELS, (right - left) / _MOST_PIXELS)
    bins = [round((top - bottom) / pixel), round((right - left) / pixel)]
    counts, _, _ = np.histogram2d(body[:, 1], body[:, 0], bins=bins, range=[[bottom, top], [left, right]])
    return np.asarray(counts, np.float64)


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Grown by two pixels, 10 cm: noise at a wall is not news."""
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
        color = color_of(state)
        axes.add_patch(
            Rectangle(
                (lower[row, 0], lower[row, 1]),
                float(tiles.grid.size[0]),
                float(tiles.grid.size[1]),
                facecolor=(*color, FILL[state]),
                edgecolor=(0.6, 0.6, 0.6, 0.35) if state is TileState.UNCHANGED else color,
                linewidth=2.0 if state is TileState.CHANGED else 0.6,
                hatch=HATCH[state],
                zorder=3 if state is TileState.CHANGED else 2,
            )
        )
        if state is TileState.CHANGED:
            _label(axes, changes, row, with_id=tile_inches >= _ROOM_FOR_ID)


def _topmost(changes: ChangeSet) -> list[int]:
    """Of each column of the grid the row of the tile that is shown: by precedence, then by score."""
    shown: dict[tuple[int, int], int] = {}
    for row in sorted(range(len(changes.states)), key=lambda row: _order(changes, row)):
        i, j, _ = changes.pairs.reference.indices[row]
        shown.setdefault((int(i), int(j)), row)
    return list(shown.values())


def _order(changes: ChangeSet, row: int) -> tuple[int, float]:
    score = float(np.nan_to_num(changes.scores[row]))
    return PRECEDENCE.index(TileState(int(changes.states[row]))), -score


def _label(axes: Axes, changes: ChangeSet, row: int, *, with_id: bool) -> None:
    """In a corner of the tile, off what stands in it: the score, and the numbers of the id that tables name."""
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
