"""The picture of a survey: the map from above, objects and tiles, title, scale bar and legend.

Where the detector found objects, these tell the story, and the tiles stand back.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke

from worker.cloud.types import Bools, Points
from worker.cloud.voxel_keys import centers
from worker.files import write_atomically
from worker.pipeline.results.changes import ChangeSet, TileState
from worker.pipeline.results.export import STATE_COLORS
from worker.pipeline.results.object_marks import (
    LIST_WIDTH,
    color_of_kind,
    draw_objects,
    legend_entries,
    list_objects,
)
from worker.pipeline.results.objects import ChangeObjects
from worker.pipeline.results.sheet import (
    ALARM,
    HEAD,
    HIGHEST,
    INK,
    LINE,
    NARROWEST,
    QUIET,
    SIDE,
    WIDEST,
    Extent,
    LeftOut,
    draw_scale_bar,
    draw_walls,
    dress_axes,
    left_out_lines,
    write_head,
)

#: How strongly a tile is filled, and a second sign beside the colour, for eyes and printers without it. Of the tiles
#: in one column of the grid the first in this order is shown; the rest would lie under it.
STYLES = {
    TileState.CHANGED: (0.4, ""),
    TileState.INCONSISTENT: (0.3, "xx"),
    TileState.UNOBSERVED: (0.1, "//"),
    TileState.UNCHANGED: (0.0, ""),
}
#: The same where objects are drawn; whoever has a colour there needs a tile to be told apart, no more.
FAINT = {
    TileState.CHANGED: (0.07, ""),
    TileState.INCONSISTENT: (0.1, "xx"),
    TileState.UNOBSERVED: (0.0, "//"),
}
PRECEDENCE = tuple(STYLES)
HATCH_WIDTH = 0.5  # points
FOOT = 1.0  # inches below it


def dress(
    figure: Figure, axes: Axes, extent: Extent, changes: ChangeSet, title: str, left_out: Sequence[LeftOut]
) -> None:
    """Write axes, title, counts and scans that were left out at the head, the legend at the foot."""
    dress_axes(axes, extent)
    doubted = changes.doubtful_placement is not None
    head = [(summary(changes), ALARM if doubted else QUIET)]
    head += [(line, QUIET) for line in left_out_lines(left_out, figure.get_figwidth())]
    write_head(figure, title, head)
    above = figure.get_figheight()
    entries = _legend(changes)
    figure.legend(
        handles=entries,
        loc="lower center",
        bbox_to_anchor=(0.5, 0.2 / above),
        ncols=len(entries),
        fontsize=8,
        frameon=False,
    )
    dashed = "" if changes.objects is None else "dashed: where it was; tiles with stray points are left out; "
    note = (
        f"seen from above, between 0.15 and 2 m over the floor; {dashed}"
        "of tiles above each other the first in this list is drawn"
    )
    figure.text(0.5, 0.14 / above, note, fontsize=6.5, color=QUIET, ha="center", va="center")


def summary(changes: ChangeSet) -> str:
    """Say in one line what a survey found, or why it says nothing."""
    if changes.doubtful_placement is not None:
        confidence = f"{changes.doubtful_placement:.2f}"
        return f"placement in doubt (confidence {confidence}): no tile counts as unchanged"
    count, of = changes.counts()["changed"], len(changes.states)
    if changes.objects is None:
        return f"{count} of {of} tiles changed, at a score above {changes.threshold:.2f}"
    things, moving = len(changes.objects.objects), changes.objects.moving
    found = f"{things or 'no'} object{'' if things == 1 else 's'} changed"
    walked = f"; {moving} more moved during the visit" if moving else ""
    return f"{found}, in {count} of {of} tiles{walked}"


def _legend(changes: ChangeSet) -> list[Patch]:
    counts = changes.counts()
    if changes.objects is None:
        entries = [_legend_entry(state, counts[state.label]) for state in PRECEDENCE]
        return [*entries, Patch(facecolor=INK, label="seen in the survey only")]
    told = [
        _legend_entry(state, counts[state.label], noun=" tiles") for state in FAINT if counts[state.label]
    ]
    return [*legend_entries(changes.objects), *told]


def _legend_entry(state: TileState, count: int, *, noun: str = "") -> Patch:
    color, (fill, hatch) = color_of(state), STYLES[state] if not noun else FAINT[state]
    return Patch(
        facecolor=(*color, max(fill, 0.05)),
        edgecolor=color,
        hatch=hatch,
        label=f"{count} {state.label}{noun}",
    )


def color_of(state: TileState) -> tuple[float, float, float]:
    """Return red, green, blue, 0..1."""
    red, green, blue = (channel / 255 for channel in STATE_COLORS[state])
    return red, green, blue


_ROOM_FOR_ID = 0.75  # inches; a smaller tile shows its score alone
_LOWEST = 2.5  # inches, where objects are listed beside it
_STRAY = 0.1  # of the points of a full tile; one with fewer neither widens the picture nor is drawn in it


def draw_picture(
    path: Path,
    reference: Points,
    current: Points,
    changes: ChangeSet,
    *,
    title: str,
    left_out: Sequence[LeftOut] = (),
) -> None:
    """Write a PNG of the map (M, 3) from above, in grey, with objects by kind and number, or else tiles by state.

    Without objects, what only the survey (N, 3) saw is drawn in ink. Map frame, metres, x to the right and y up;
    ceilings are cut away. The head says where the placement is in doubt, and which scans were `left_out`. Raises
    OSError.
    """
    extent = _extent(changes)
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    scale = min(WIDEST / width, HIGHEST / height)  # inches a metre
    things = [] if changes.objects is None else changes.objects.objects
    beside = LIST_WIDTH if things else 0.0
    plan = max(
        width * scale, NARROWEST - beside
    )  # inches that the plan and what is left and right of it take
    head = HEAD + (LINE if left_out else 0.0)
    sheet = (plan + 2 * SIDE + beside, max(height * scale, _LOWEST if things else 0.0) + head + FOOT)
    figure = Figure(figsize=sheet, dpi=130, facecolor="white")
    FigureCanvasAgg(figure)
    place = ((SIDE + (plan - width * scale) / 2) / sheet[0], FOOT / sheet[1])
    axes = figure.add_axes((*place, width * scale / sheet[0], height * scale / sheet[1]))
    draw_walls(axes, reference, current, extent, with_news=changes.objects is None)
    _draw_tiles(axes, changes, tile_inches=float(changes.pairs.reference.grid.size[0]) * scale)
    if changes.objects is not None:
        _draw_voxels(axes, changes.objects)
        draw_objects(axes, changes.objects.objects, scale=scale)
        list_objects(figure, things, left=SIDE + plan + 0.25, top=sheet[1] - head, bottom=FOOT)
    draw_scale_bar(figure, extent, scale)
    dress(figure, axes, extent, changes, title, left_out)
    with rc_context({"hatch.linewidth": HATCH_WIDTH}):
        write_atomically(path, lambda aside: figure.savefig(aside, format="png"))


def _extent(changes: ChangeSet) -> Extent:
    """Return left, right, bottom, top in metres: all tiles that tell something, and half a metre around."""
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    told = _telling(changes)
    lower = lower[told] if told.any() else lower
    left, bottom = lower[:, :2].min(axis=0) - 0.5
    right, top = (lower + tiles.grid.size)[:, :2].max(axis=0) + 0.5
    return float(left), float(right), float(bottom), float(top)


def _telling(changes: ChangeSet) -> Bools:
    """Tell (T,) which tiles have changed, or hold more than what was seen through a window or beside a mirror."""
    counts = np.array(
        [len(a) + len(b) for a, b in zip(changes.pairs.reference.points, changes.pairs.current, strict=True)]
    )
    few = _STRAY * np.percentile(counts, 90) if len(counts) else 0.0
    telling: Bools = (counts >= few) | (changes.states == TileState.CHANGED)
    return telling


def _draw_voxels(axes: Axes, objects: ChangeObjects) -> None:
    """Draw the voxels of the objects in the colours of their kinds."""
    for numbers in (objects.before, objects.now):
        some = np.flatnonzero(numbers)
        if not len(some):
            continue
        colors = np.array([color_of_kind(thing.kind) for thing in objects.objects])[numbers[some] - 1]
        flat = centers(objects.keys[some], objects.voxel_size)[:, :2]
        for color in np.unique(colors, axis=0):
            own = flat[(colors == color).all(axis=1)]
            cells = np.unique(np.round(own, 4), axis=0) - objects.voxel_size / 2
            squares = [
                Rectangle((float(x), float(y)), objects.voxel_size, objects.voxel_size) for x, y in cells
            ]
            axes.add_collection(
                PatchCollection(squares, facecolor=(*color, 0.45), edgecolor="none", zorder=4)
            )


def _draw_tiles(axes: Axes, changes: ChangeSet, *, tile_inches: float) -> None:
    tiles = changes.pairs.reference
    lower = tiles.grid.lower(tiles.indices)
    faint, told = changes.objects is not None, _telling(changes)
    for row in _topmost(changes):
        state = TileState(int(changes.states[row]))
        changed = state is TileState.CHANGED
        if faint and (state not in FAINT or not told[row]):
            continue
        color, (fill, hatch) = color_of(state), (FAINT if faint else STYLES)[state]
        edge = (0.6, 0.6, 0.6, 0.35) if state is TileState.UNCHANGED else (*color, 0.35 if faint else 1.0)
        axes.add_patch(
            Rectangle(
                (lower[row, 0], lower[row, 1]),
                float(tiles.grid.size[0]),
                float(tiles.grid.size[1]),
                facecolor=(*color, fill),
                edgecolor=edge,
                linewidth=2.0 if changed and not faint else 0.6,
                hatch=hatch,
                zorder=3 if changed else 2,
            )
        )
        if changed and not faint:
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
