"""Two pictures of a built map: its pose graph from above, and each scan's error against its sigma."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from worker.benchmarks.registration.assessment import Assessment
from worker.benchmarks.registration.scenario import Scenario
from worker.cloud.poses import inverse, transformed
from worker.cloud.types import Floats, Matrix4, Points
from worker.pipeline.flow import BuiltMap

KEPT, THROWN, MISSING, INK, QUIET = "#2e7d32", "#c62828", "#ef6c00", "#1a1a1a", "#666666"
_PIXEL = 0.05  # metres
_BODY = (0.15, 2.0)  # metres above the floor: what is drawn of the map
_WIDEST, _HIGHEST, _NARROWEST = 10.0, 9.0, 6.5  # inches


def draw_run(folder: Path, scenario: Scenario, seed: int, built: BuiltMap, found: Assessment) -> None:
    """Write `map-KIND-SEED.png` and `errors-KIND-SEED.png` into the folder. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{scenario.kind}, seed {seed}: {len(found.errors)} of {found.scans} scans"
    _save(_map(scenario, built, found, title), folder / f"map-{scenario.kind}-{seed}.png")
    _save(_errors(found, title), folder / f"errors-{scenario.kind}-{seed}.png")


def _map(scenario: Scenario, built: BuiltMap, found: Assessment, title: str) -> Figure:
    picture, extent = _walls(built.reference.points)
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    scale = min(_WIDEST / width, _HIGHEST / height)
    figure = Figure(
        figsize=(max(width * scale, _NARROWEST) + 0.8, height * scale + 1.4), dpi=120, layout="constrained"
    )
    axes = figure.add_subplot()
    axes.imshow(picture, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, zorder=0)
    places = _places(scenario, built, found)
    _draw_edges(axes, built, places)
    _draw_stops(axes, scenario, built, places)
    axes.set_title(title, loc="left", fontsize=11, color=INK, weight="bold")
    axes.set_xlabel("x of the map (m)", fontsize=8, color=QUIET)
    axes.set_ylabel("y of the map (m)", fontsize=8, color=QUIET)
    axes.tick_params(labelsize=7, colors=QUIET)
    axes.set_aspect("equal")
    figure.legend(handles=_legend(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _walls(points: Points) -> tuple[NDArray[np.float64], tuple[float, float, float, float]]:
    """(rows, columns) grey, 1 where nothing stands; left, right, bottom, top in metres."""
    floor = float(np.percentile(points[:, 2], 1))
    body = points[(points[:, 2] > floor + _BODY[0]) & (points[:, 2] < floor + _BODY[1])]
    low, high = points[:, :2].min(axis=0) - 0.5, points[:, :2].max(axis=0) + 0.5
    bins = np.ceil((high - low) / _PIXEL).astype(int)
    counts, _, _ = np.histogram2d(
        body[:, 1], body[:, 0], bins=bins[::-1].tolist(), range=[[low[1], high[1]], [low[0], high[0]]]
    )
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    return 1 - 0.5 * np.clip(counts / 12, 0, 1), extent


def _places(scenario: Scenario, built: BuiltMap, found: Assessment) -> dict[int, Floats]:
    """(3,) by index: where the map has a scan; where it was in truth for one of the building that is missing."""
    places: dict[int, Floats] = {}
    for at, (outcome, true) in enumerate(zip(built.outcomes, scenario.true, strict=True)):
        if outcome.registration:
            places[at] = outcome.registration.map_from_scan[:3, 3]
        elif true is not None and found.true_from_map is not None:
            places[at] = _moved(true, inverse(found.true_from_map))
    return places


def _moved(pose: Matrix4, target_from_source: Matrix4) -> Floats:
    place: Floats = transformed(pose[None, :3, 3], target_from_source)[0]
    return place


def _draw_edges(axes: Axes, built: BuiltMap, places: dict[int, Floats]) -> None:
    for pairs, color, order in ((built.kept, KEPT, 2), (built.rejected, THROWN, 3)):
        for pair in pairs:
            if pair.target in places and pair.source in places:
                ends = np.stack([places[pair.target], places[pair.source]])
                axes.plot(ends[:, 0], ends[:, 1], color=color, linewidth=0.9, alpha=0.7, zorder=order)


def _draw_stops(axes: Axes, scenario: Scenario, built: BuiltMap, places: dict[int, Floats]) -> None:
    for at, place in places.items():
        missing, foreign = built.outcomes[at].registration is None, scenario.true[at] is None
        color = MISSING if missing else THROWN if foreign else INK
        axes.plot(place[0], place[1], "x" if missing or foreign else "o", color=color, markersize=5, zorder=4)
        axes.annotate(
            built.outcomes[at].name.removeprefix("stop-"),
            (float(place[0]), float(place[1])),
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=6,
            color=color,
            zorder=5,
        )


def _legend() -> Sequence[Line2D]:
    lines = [Line2D([], [], color=KEPT, label="pair that was kept")]
    lines.append(Line2D([], [], color=THROWN, label="thrown out as a wrong loop"))
    marks = (
        ("o", INK, "stop"),
        ("x", MISSING, "left out, drawn where it truly was"),
        ("x", THROWN, "of another building, and yet placed"),
    )
    return lines + [
        Line2D([], [], marker=marker, color=color, linestyle="", markersize=5, label=label)
        for marker, color, label in marks
    ]


def _errors(found: Assessment, title: str) -> Figure:
    rows = found.document()["scans"]
    figure = Figure(figsize=(max(6.0, 0.24 * len(rows) + 1.5), 5.0), dpi=120, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.set_title(title, loc="left", fontsize=11, color=INK, weight="bold")
    _bars(above, rows, "centimetres", "off the truth (cm)")
    _bars(below, rows, "degrees", "off the truth (degrees)")
    below.set_xticks(range(len(rows)), [row["name"].removeprefix("stop-") for row in rows], rotation=90)
    below.tick_params(labelsize=7)
    handles = [*above.get_legend_handles_labels()]
    figure.legend(*handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _bars(axes: Axes, rows: list[dict[str, Any]], unit: str, label: str) -> None:
    """What sigma speaks of, the error seen from the reference scan, and the error after the best fit of all."""
    places = np.arange(len(rows))
    seen, twice = (
        [np.nan if row[name + unit] is None else row[name + unit] for row in rows]
        for name in ("from_reference_", "sigma_")
    )
    axes.bar(places, seen, color="#b0bec5", label="error, seen from the reference scan")
    axes.plot(places, 2 * np.array(twice), "_", color=THROWN, markersize=7, label="twice the sigma of that")
    axes.plot(places, [row[unit] for row in rows], ".", color=INK, markersize=4, label="error, frames fitted")
    axes.set_ylabel(label, fontsize=8, color=QUIET)
    axes.tick_params(labelsize=7, colors=QUIET)


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    aside = path.with_name(path.name + ".tmp")
    figure.savefig(aside, format="png")
    aside.replace(path)
