"""Marks of objects in the picture: boxes with numbers, arrows for what was moved, and the list beside the plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Patch, Polygon
from matplotlib.patheffects import withStroke

from worker.cloud.types import Floats
from worker.pipeline.results.objects import ChangeObject, ChangeObjects, ObjectKind
from worker.pipeline.results.places import Place
from worker.pipeline.results.sheet import INK, QUIET

#: Colour-blind-safe (Okabe and Ito, 2008): vermilion, blue, reddish purple; as in the coloured cloud where that has it
OBJECT_COLORS: dict[ObjectKind, tuple[int, int, int]] = {
    "appeared": (213, 94, 0),
    "disappeared": (0, 114, 178),
    "moved": (170, 68, 130),
}
LIST_WIDTH = 3.0  #: inches, beside the plan
MOST_LISTED = 16  #: objects; the rest is counted
ON_THE_FLOOR = 0.2  #: metres; what hangs lower stands there, for nothing is told right above a floor
_BADGE = 0.2  # inches across
_LEAST_SHIFT, _LEAST_TURN = 0.15, np.radians(10)  # metres for an arrow, radians that are told
_AROUND = np.radians([45, 135, 315, 225, 90, 0, 180, 270])  # where a number may stand, best first


def color_of_kind(kind: ObjectKind) -> tuple[float, float, float]:
    """Return red, green, blue, 0..1."""
    red, green, blue = (channel / 255 for channel in OBJECT_COLORS[kind])
    return red, green, blue


def draw_objects(axes: Axes, objects: Sequence[ChangeObject], *, scale: float) -> None:
    """Draw boxes, arrows and numbers on the plan; `scale` is inches a metre."""
    for thing in objects:
        color = color_of_kind(thing.kind)
        if thing.before is not None:
            axes.add_patch(_box(thing.before, color, gone=True))
        if thing.now is not None:
            axes.add_patch(_box(thing.now, color, gone=False))
        if thing.before is not None and thing.now is not None:
            _draw_arrow(axes, thing.before, thing.now, color)
    for thing, place in zip(objects, badge_places(objects, scale), strict=True):
        _draw_badge(axes, thing, (float(place[0]), float(place[1])))


def legend_entries(objects: ChangeObjects) -> list[Patch]:
    """Return a sample of each kind with its count."""
    entries = []
    for kind, count in objects.counts().items():
        color = color_of_kind(kind)  # type: ignore[arg-type]
        sample = Patch(facecolor=(*color, 0.25), edgecolor=color, label=f"{count} {kind}")
        sample.set_linestyle("dashed" if kind == "disappeared" else "solid")
        entries.append(sample)
    return entries


def list_objects(
    figure: Figure, objects: Sequence[ChangeObject], *, left: float, top: float, bottom: float
) -> None:
    """Write the objects below each other, two lines each; inches from the sheet's left and lower edge."""
    wide, high = figure.get_size_inches()
    step = 0.34
    room = min(MOST_LISTED, max(int((top - bottom) / step) - 1, 1))
    for row, thing in enumerate(objects[:room]):
        y = top - step * (row + 0.5)
        figure.text(
            (left + 0.1) / wide,
            (y + 0.02) / high,
            str(thing.number),
            fontsize=7,
            color="white",
            weight="bold",
            ha="center",
            va="center",
            bbox={"boxstyle": "circle,pad=0.25", "facecolor": color_of_kind(thing.kind), "edgecolor": "none"},
        )
        figure.text(
            (left + 0.28) / wide, (y + 0.07) / high, headline(thing), fontsize=8, color=INK, va="center"
        )
        figure.text(
            (left + 0.28) / wide, (y - 0.07) / high, details(thing), fontsize=6.5, color=QUIET, va="center"
        )
    if len(objects) > room:
        y = top - step * (room + 0.4)
        figure.text(
            (left + 0.28) / wide, y / high, f"and {len(objects) - room} smaller ones", fontsize=7, color=QUIET
        )


def headline(thing: ChangeObject) -> str:
    """Say what became of a thing: `moved by 1.2 m, turned by 25°`."""
    if thing.motion is None:
        return thing.kind
    shift, yaw = float(np.linalg.norm(thing.motion.translation)), thing.motion.yaw
    turned = "" if yaw is None or abs(yaw) < _LEAST_TURN else f", turned by {np.degrees(abs(yaw)):.0f}°"
    return f"moved by {shift:.1f} m{turned}"


def details(thing: ChangeObject) -> str:
    """Say how large a thing is and how high it stands."""
    place = thing.now or thing.before
    if place is None:
        raise ValueError(f"object {thing.number} is nowhere")
    size = " × ".join(f"{edge:.1f}" for edge in place.size)
    return f"{size} m, {_height(place)}"


def _height(place: Place) -> str:
    if place.height_over_floor is None:
        return f"from z = {place.center[2] - place.size[2] / 2:.1f} m"
    if place.height_over_floor < ON_THE_FLOOR:
        return "on the floor"
    return f"{place.height_over_floor:.1f} m over the floor"


def corners(place: Place) -> Floats:
    """Return (4, 2) metres, map frame: the outline of the box from above."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(place.size[:2]) / 2
    cosine, sine = np.cos(place.yaw), np.sin(place.yaw)
    outline: Floats = half @ np.array([[cosine, sine], [-sine, cosine]]) + np.asarray(place.center[:2])
    return outline


def _box(place: Place, color: tuple[float, float, float], *, gone: bool) -> Polygon:
    return Polygon(
        corners(place).tolist(),
        closed=True,
        facecolor=(*color, 0.08 if gone else 0.22),
        edgecolor=color,
        linestyle=(0, (3, 2)) if gone else "solid",
        linewidth=1.4,
        zorder=5,
    )


def _draw_arrow(axes: Axes, before: Place, now: Place, color: tuple[float, float, float]) -> None:
    if np.hypot(now.center[0] - before.center[0], now.center[1] - before.center[1]) < _LEAST_SHIFT:
        return
    axes.add_patch(
        FancyArrowPatch(
            before.center[:2],
            now.center[:2],
            arrowstyle="-|>",
            mutation_scale=11,
            shrinkA=0,
            shrinkB=0,
            linewidth=1.6,
            color=color,
            zorder=6,
            path_effects=[withStroke(linewidth=3.2, foreground="white")],
        )
    )


def _draw_badge(axes: Axes, thing: ChangeObject, at: tuple[float, float]) -> None:
    axes.annotate(
        str(thing.number),
        at,
        ha="center",
        va="center",
        fontsize=7.5,
        color="white",
        weight="bold",
        zorder=8,
        annotation_clip=False,
        bbox={
            "boxstyle": "circle,pad=0.25",
            "facecolor": color_of_kind(thing.kind),
            "edgecolor": "white",
            "linewidth": 0.8,
        },
    )


def badge_places(objects: Sequence[ChangeObject], scale: float) -> list[Floats]:
    """Return where each number stands, metres: at its own box, off other boxes and numbers as far as there is room."""
    size = _BADGE / scale
    boxes = [corners(place) for thing in objects for place in thing.places]
    taken: list[Floats] = []
    for thing in objects:
        place = thing.now or thing.places[0]
        own, center = corners(place), np.asarray(place.center[:2])
        choices = [
            _rim(own, center, angle) + size * 0.6 * np.array([np.cos(angle), np.sin(angle)])
            for angle in _AROUND
        ]
        costs = [
            _crowding(at, taken, size) * 3 + _covered(at, boxes, size) + 0.05 * rank
            for rank, at in enumerate(choices)
        ]
        taken.append(choices[int(np.argmin(costs))])
    return taken


def _rim(own: Floats, center: Floats, angle: float) -> Floats:
    """Return the point of a box's outline (4, 2) that lies farthest in a direction from its centre."""
    towards = np.array([np.cos(angle), np.sin(angle)])
    reach = ((own - center) @ towards).max()
    rim: Floats = center + towards * reach * 0.85
    return rim


def _crowding(at: Floats, taken: Sequence[Floats], size: float) -> float:
    """Return how much of a number would lie on numbers that have their places."""
    gaps = np.linalg.norm(np.array(taken).reshape(-1, 2) - at, axis=1)
    return float(np.maximum(0.0, 1 - gaps / (1.2 * size)).sum())


def _covered(at: Floats, boxes: Sequence[Floats], size: float) -> int:
    """Count the boxes that a number would stand on, roughly: by their axis-aligned bounds."""
    low = np.array([box.min(axis=0) for box in boxes]) - size / 2
    high = np.array([box.max(axis=0) for box in boxes]) + size / 2
    return int(((at > low) & (at < high)).all(axis=1).sum())
