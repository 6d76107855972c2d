"""The sheet that pictures of surveys are drawn on: map from above, axes, scale bar, and what is written at the head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from worker.cloud.types import Points

Extent = tuple[float, float, float, float]  #: left, right, bottom, top; metres, map frame

INK = "#1a1a1a"
QUIET = "#666666"
ALARM = "#b00020"  #: of what must not be overlooked
HEAD, SIDE = 0.75, 0.55  #: inches above the map, and left and right of it
LINE = 0.2  #: inches of a further line at the head
CHARACTERS = 15  #: of such a line in an inch
WIDEST, HIGHEST, NARROWEST = 11.0, 9.0, 6.5  #: inches of the map's part of the picture

_PIXEL = 0.05  # metres, or more where the picture would have too many
_MOST_PIXELS = 4000  # along a side
_AT_ONCE = 1_000_000  # points that are counted together
_DARKEST_WALL = 0.5  # grey of the map, so that ink on it is seen at once


@dataclass(frozen=True, kw_only=True, slots=True)
class LeftOut:
    """A scan that a picture names because it was left out."""

    name: str  #: of its file
    reason: str  #: of the documented list; empty where an earlier release left it out
    detail: str  #: the sentence


def draw_scale_bar(figure: Figure, extent: Extent, scale: float) -> None:
    """Draw a scale bar at the head, on the right; `scale` is inches a metre."""
    wide, high = figure.get_size_inches()
    longest = max((extent[1] - extent[0]) / 4, 0.5)
    length = next(size for size in (20.0, 10.0, 5.0, 2.0, 1.0, 0.5) if size <= longest)
    right, y = 1 - SIDE / wide, 1 - 0.6 / high
    left = right - length * scale / wide
    figure.add_artist(Line2D((left, right), (y, y), color=INK, linewidth=3, solid_capstyle="butt"))
    figure.text((left + right) / 2, y + 0.06 / high, f"{length:g} m", ha="center", fontsize=8, color=INK)


def dress_axes(axes: Axes, extent: Extent) -> None:
    """Write metres along the map."""
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])
    axes.tick_params(labelsize=7, colors=QUIET, length=2)
    axes.set_xlabel("x of the map (m)", fontsize=8, color=QUIET)
    axes.set_ylabel("y of the map (m)", fontsize=8, color=QUIET)
    for spine in axes.spines.values():
        spine.set_visible(False)


def write_head(figure: Figure, title: str, lines: Sequence[tuple[str, str]]) -> None:
    """Write the title and lines below it, each in its colour; names of files are written as they are, `$` and all."""
    above, left = figure.get_figheight(), SIDE / figure.get_figwidth()
    figure.text(left, 1 - 0.3 / above, title, fontsize=12, color=INK, va="center", weight="bold")
    for number, (line, color) in enumerate(lines):
        figure.text(
            left,
            1 - (0.55 + number * LINE) / above,
            line,
            fontsize=9,
            color=color,
            va="center",
            weight="bold" if color == ALARM else "normal",
            parse_math=False,
        )


def left_out_lines(left_out: Sequence[LeftOut], width: float) -> list[str]:
    """Return one line that names scans that were left out with the reason, as many as it has room for; or none."""
    if not left_out:
        return []
    room = int((width - 2 * SIDE) * CHARACTERS) - len("left out: , and 999 more")
    shown = [
        f"{scan.name} ({scan.reason.replace('_', ' ')})" if scan.reason else scan.name for scan in left_out
    ]
    while len(shown) > 1 and len(", ".join(shown)) > room:
        shown.pop()
    more = len(left_out) - len(shown)
    return [f"left out: {', '.join(shown)}" + (f", and {more} more" if more else "")]


def draw_walls(axes: Axes, reference: Points, current: Points, extent: Extent, *, with_news: bool) -> None:
    """Draw how much stands above each spot between knee and head, so that furniture and walls show."""
    floor = float(np.percentile(reference[:, 2], 1))
    before, now = (standing(points, floor, extent) for points in (reference, current))
    shade = np.clip(before / 12.0, 0, 1) * _DARKEST_WALL
    picture = np.repeat(1 - shade[:, :, None], 3, axis=2)
    if with_news:
        only_now = (now > 2) & ~_near(before > 0)
        picture[only_now] = to_rgb(INK)
    axes.imshow(picture, origin="lower", extent=extent, interpolation="antialiased", zorder=0)


def standing(points: Points, floor: float, extent: Extent) -> NDArray[np.float64]:
    """Return (rows, columns) voxels from 15 cm to 2 m above the floor in each pixel."""
    left, right, bottom, top = extent
    pixel = max(_PIXEL, (top - bottom) / _MOST_PIXELS, (right - left) / _MOST_PIXELS)
    bins = [round((top - bottom) / pixel), round((right - left) / pixel)]
    counts = np.zeros(bins)
    for start in range(0, len(points), _AT_ONCE):
        some = points[start : start + _AT_ONCE]
        body = some[(some[:, 2] > floor + 0.15) & (some[:, 2] < floor + 2.0)]
        counts += np.histogram2d(body[:, 1], body[:, 0], bins=bins, range=[[bottom, top], [left, right]])[0]
    return counts


def _near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Grow the mask by two pixels, 10 cm: noise at a wall is no change."""
    grown = mask.copy()
    for axis in (0, 1):
        for shift in (-2, -1, 1, 2):
            grown |= np.roll(mask, shift, axis=axis)
    return grown
