"""Pictures: two visits from above with what each model says of them, and each object of the first model near by."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from worker.benchmarks import plots
from worker.benchmarks.plots import MISSED, QUIET
from worker.benchmarks.real.answers import Answer, FoundObject
from worker.benchmarks.real.edits import VOXEL, EditedVisits
from worker.benchmarks.real.visits import RealScan, TwoVisits
from worker.cloud.types import Floats, Points
from worker.cloud.voxel_keys import Keys, centers
from worker.pipeline.results.changes import TileState
from worker.pipeline.results.objects import ChangeObject
from worker.pipeline.results.places import Place

GONE, NEW = "#c62828", "#2e7d32"  #: what only the map has, and what only the survey has
MAP, SURVEY = "#1565c0", "#ef6c00"
AROUND = 0.9  #: metres that a picture of an object shows around it
_MOST_OBJECTS = 4  # that are drawn near by
_MOST_POINTS = 60_000  # of a plan


def draw_visits(folder: Path, visits: TwoVisits, answers: Sequence[Answer]) -> None:
    """Write `NAME.png`, a plan a model, and `NAME-objects.png` of the first model that tells objects. Raises OSError."""
    name = file_name(visits.name)
    plots.save(plans(visits, answers), folder / f"{name}.png")
    told = next((answer for answer in answers if answer.objects), None)
    if told is not None and told.objects:
        plots.save(near_by(visits, told), folder / f"{name}-objects.png")


def draw_edited(folder: Path, edited: EditedVisits, answer: Answer) -> None:
    """Write `edited-NAME.png`: what was put in, and what the model found of it. Raises OSError."""
    plots.save(edited_plan(edited, answer), folder / f"edited-{file_name(edited.visits.name)}.png")


def file_name(name: str) -> str:
    """Return a name as that of a file."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def plans(visits: TwoVisits, answers: Sequence[Answer]) -> Figure:
    """Draw the place from above, a panel a model: outlines of objects, changed tiles faintly."""
    figure = Figure(figsize=(4.6 * len(answers), 4.6), dpi=80, layout="constrained")
    for axes, answer in zip(np.atleast_1d(figure.subplots(1, len(answers))), answers, strict=True):
        _plan(axes, visits)
        lower, size = answer.grid.lower(answer.tiles), answer.grid.size
        for tile in np.flatnonzero(answer.states == TileState.CHANGED).tolist():
            corner = (float(lower[tile, 0]), float(lower[tile, 1]))
            axes.add_patch(Rectangle(corner, size[0], size[1], facecolor=MISSED, alpha=0.15))
        for thing in answer.objects or ():
            _outline(axes, thing.change)
        objects = "no objects told" if answer.objects is None else f"{len(answer.objects)} objects"
        counts = answer.counts()
        axes.set_title(
            f"{answer.model}: {objects}, {counts['changed']} tiles changed", fontsize=9, loc="left"
        )
    figure.suptitle(visits.name, fontsize=11, x=0.01, ha="left", weight="bold")
    return figure


def edited_plan(edited: EditedVisits, answer: Answer) -> Figure:
    """Draw what was put in, from above, blue and where the other visit decides it dark; and the objects of a model."""
    figure = Figure(figsize=(7, 6), dpi=80, layout="constrained")
    axes = figure.add_subplot()
    _plan(axes, edited.visits)
    for region in edited.regions:
        _dots(axes, region.hit, "#90caf9", size=4)
        _dots(axes, region.decidable, MAP, size=4)
    for thing in answer.objects or ():
        _outline(axes, thing.change)
    axes.set_title(
        f"{edited.visits.name}\n{answer.model}; blue: put in (dark: decidable)", fontsize=8, loc="left"
    )
    return figure


def near_by(visits: TwoVisits, answer: Answer) -> Figure:
    """Draw each of the largest objects from above and from a side: map blue, survey orange, its voxels ringed."""
    objects = (answer.objects or ())[:_MOST_OBJECTS]
    figure = Figure(figsize=(8, 3.8 * len(objects)), dpi=80, layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(objects), 2))
    for row, thing in zip(grid, objects, strict=True):
        for axes, across in zip(row, ((0, 1), (0, 2)), strict=True):
            _close_up(axes, visits, thing, across)
        words = f"{thing.change.number}: {thing.change.kind}, {len(thing.before)} and {len(thing.now)} voxels"
        row[0].set_title(words, fontsize=9, loc="left")
    figure.suptitle(f"{visits.name}, {answer.model}", fontsize=10, x=0.01, ha="left")
    return figure


def _close_up(axes: Axes, visits: TwoVisits, thing: FoundObject, across: tuple[int, int]) -> None:
    places = centers(np.union1d(thing.before, thing.now), VOXEL)
    low, high = places.min(axis=0) - AROUND, places.max(axis=0) + AROUND
    other = 3 - sum(across)
    for scans, color in ((visits.first, MAP), (visits.second, SURVEY)):
        points = _points(scans)
        inside = points[((points > low) & (points < high)).all(axis=1)]
        near = np.abs(inside[:, other] - places[:, other].mean()) < np.ptp(places[:, other]) / 2 + 0.3
        axes.scatter(inside[near, across[0]], inside[near, across[1]], s=2, c=color, linewidths=0)
    for keys, color in ((thing.before, GONE), (thing.now, NEW)):
        spots = centers(keys, VOXEL)
        axes.scatter(
            spots[:, across[0]],
            spots[:, across[1]],
            s=16,
            facecolors="none",
            edgecolors=color,
            linewidths=0.5,
        )
    axes.set_aspect("equal")
    axes.set_xlim(low[across[0]], high[across[0]])
    axes.set_ylim(low[across[1]], high[across[1]])
    plots.label(axes, f"{'xyz'[across[0]]} (m)", f"{'xyz'[across[1]]} (m)", legend=False)


def _plan(axes: Axes, visits: TwoVisits) -> None:
    points = _points((*visits.first, *visits.second))
    low, high = np.percentile(points[:, :2], [1.5, 98.5], axis=0)
    plots.draw_plan(axes, points[((points[:, :2] > low - 0.5) & (points[:, :2] < high + 0.5)).all(axis=1)])
    for scan in (*visits.first, *visits.second):
        if scan.sensor_origin is not None:
            axes.plot(*scan.sensor_origin[:2], "+", color=QUIET, markersize=7)


def _points(scans: Sequence[RealScan]) -> Points:
    return np.concatenate([scan.points[:: 1 + len(scan.points) // _MOST_POINTS] for scan in scans])


def _outline(axes: Axes, thing: ChangeObject) -> None:
    for place, color in ((thing.before, GONE), (thing.now, NEW)):
        if place is not None:
            axes.add_patch(
                Polygon(_corners(place).tolist(), facecolor="none", edgecolor=color, linewidth=1.6)
            )
            axes.annotate(f"{thing.number}", place.center[:2], color=color, fontsize=9, weight="bold")


def _corners(place: Place) -> Floats:
    half = np.asarray(place.size[:2]) / 2
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    cosine, sine = np.cos(place.yaw), np.sin(place.yaw)
    return np.asarray(corners @ np.array([[cosine, sine], [-sine, cosine]]) + np.asarray(place.center[:2]))


def _dots(axes: Axes, keys: Keys, color: str, *, size: float) -> None:
    spots = centers(keys, VOXEL)
    axes.scatter(spots[:, 0], spots[:, 1], s=size, c=color, linewidths=0)
