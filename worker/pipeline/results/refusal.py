"""The picture of a survey of which no scan was accepted: the map from above, and why each scan was refused."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from worker.cloud.types import Points
from worker.files import write_atomically
from worker.pipeline.results.sheet import (
    ALARM,
    CHARACTERS,
    HEAD,
    HIGHEST,
    INK,
    LINE,
    NARROWEST,
    QUIET,
    SIDE,
    WIDEST,
    LeftOut,
    draw_scale_bar,
    draw_walls,
    dress_axes,
    write_head,
)

_FOOT = 0.6  # inches below the map; there is no legend
_MOST_LINES = 24  # of reasons


def draw_refusal(path: Path, reference: Points, left_out: Sequence[LeftOut], *, title: str) -> None:
    """Write a PNG of the map (M, 3) from above with the reason why each scan of a survey was refused. Raises OSError."""
    left, bottom = (float(value) for value in np.percentile(reference[:, :2], 0.5, axis=0) - 0.5)
    right, top = (float(value) for value in np.percentile(reference[:, :2], 99.5, axis=0) + 0.5)
    extent = (left, right, bottom, top)
    scale = min(WIDEST / (right - left), HIGHEST / (top - bottom))  # inches a metre
    plan = max((right - left) * scale, NARROWEST)
    lines = _refusals(left_out, int(plan * CHARACTERS))
    head = HEAD + len(lines) * LINE
    sheet = (plan + 2 * SIDE, (top - bottom) * scale + head + _FOOT)
    figure = Figure(figsize=sheet, dpi=130, facecolor="white")
    FigureCanvasAgg(figure)
    width, height = (right - left) * scale / sheet[0], (top - bottom) * scale / sheet[1]
    place = ((1 - width) / 2, _FOOT / sheet[1], width, height)
    axes = figure.add_axes(place)
    draw_walls(axes, reference, reference[:0], extent, with_news=False)
    dress_axes(axes, extent)
    draw_scale_bar(figure, extent, scale)
    count = "the scan was" if len(left_out) == 1 else f"all {len(left_out)} scans were"
    write_head(figure, title, [(f"{count} refused: nothing is said of the place", ALARM), *lines])
    write_atomically(path, lambda aside: figure.savefig(aside, format="png"))


def _refusals(left_out: Sequence[LeftOut], characters: int) -> list[tuple[str, str]]:
    """Return the reasons as lines of so many characters, each with its colour; the last counts what has no room."""
    lines: list[tuple[str, str]] = []
    for number, scan in enumerate(left_out):
        reason = scan.reason.replace("_", " ")
        told = [
            (f"{scan.name}: {reason}"[:characters], INK),
            *((line, QUIET) for line in wrap(scan.detail, characters)),
        ]
        if lines and len(lines) + len(told) > _MOST_LINES:
            return [*lines, (f"and {len(left_out) - number} more", QUIET)]
        lines += told
    return lines
