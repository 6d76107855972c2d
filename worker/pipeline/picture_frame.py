"""What stands around the map in a picture, and the look that both share: title, scale bar, legend."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from worker.pipeline.changes import ChangeSet, TileState
from worker.pipeline.export import STATE_COLORS

Extent = tuple[float, float, float, float]  #: left, right, bottom, top; metres, map frame

INK = "#1a1a1a"
QUIET = "#666666"
#: of the tiles in one column of the grid, the one that is shown; the rest would lie under it
PRECEDENCE = (TileState.CHANGED, TileState.INCONSISTENT, TileState.UNOBSERVED, TileState.UNCHANGED)
FILL = {
    TileState.CHANGED: 0.4,
    TileState.INCONSISTENT: 0.3,
    TileState.UNOBSERVED: 0.1,
    TileState.UNCHANGED: 0.0,
}
#: a second sign beside the colour, for eyes and printers without it
HATCH = {
    TileState.CHANGED: "",
    TileState.INCONSISTENT: "xx",
    TileState.UNOBSERVED: "//",
    TileState.UNCHANGED: "",
}
HATCH_WIDTH = 0.5  # points
HEAD, FOOT, SIDE = 0.75, 1.0, 0.55  # inches above, below and left of it


def draw_scale_bar(figure: Figure, extent: Extent, scale: float) -> None:
    """At the head, on the right; `scale` is inches a metre."""
    wide, high = figure.get_size_inches()
    longest = max((extent[1] - extent[0]) / 4, 0.5)
    length = next(size for size in (20.0, 10.0, 5.0, 2.0, 1.0, 0.5) if size <= longest)
    right, y = 1 - SIDE / wide, 1 - 0.6 / high
    left = right - length * scale / wide
    figure.add_artist(Line2D((left, right), (y, y), color=INK, linewidth=3, solid_capstyle="butt"))
    figure.text((left + right) / 2, y + 0.06 / high, f"{length:g} m", ha="center", fontsize=8, color=INK)


def dress(figure: Figure, axes: Axes, extent: Extent, changes: ChangeSet, title: str) -> None:
    """Axes, title and counts at the head, legend at the foot."""
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
    note = "seen from above, between 0.15 and 2 m over the floor; of tiles above each other the first in this list is drawn"
    figure.text(0.5, 0.14 / above, note, fontsize=6.5, color=QUIET, ha="center", va="center")


def _legend_entry(state: TileState, count: int) -> Patch:
    color = color_of(state)
    return Patch(
        facecolor=(*color, max(FILL[state], 0.05)),
        edgecolor=color,
        hatch=HATCH[state],
        label=f"{count} {state.label}",
    )


def color_of(state: TileState) -> tuple[float, float, float]:
    """Red, green, blue, 0..1."""
    red, green, blue = (channel / 255 for channel in STATE_COLORS[state])
    return red, green, blue
