"""Pictures of impostors: map and scan from above, at the pose that fits best, and what contradicts that pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from worker.benchmarks import plots
from worker.benchmarks.placement.answers import ScanAnswer
from worker.benchmarks.placement.measures import Answered
from worker.benchmarks.placement.plan import PlacementSettings
from worker.benchmarks.placement.sites import PlacementSite, load_site
from worker.benchmarks.placement.surveys import simulate
from worker.benchmarks.plots import COLORS, INK, MISSED, WRONG
from worker.cloud.poses import transformed
from worker.cloud.sight import Sights
from worker.cloud.types import Bools, Floats, Matrix4, Points
from worker.cloud.voxels import Voxels
from worker.errors import RegistrationFailed
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.refinement import Refinement
from worker.pipeline.registration.scan_to_map import global_registration
from worker.pipeline.settings import PipelineSettings

BODY = (0.15, 0.25)  #: metres over the floor and under the ceiling that are left out, so that walls are seen
_SHARES = (1.0, 99.0)  # percent of the map's heights taken for floor and ceiling


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Contradicted:
    """What cannot stand if the pose is right."""

    scan: Bools  #: (N,) points of the scan where the map's scans saw through
    map: Bools  #: (M,) points of the map where the scan saw through


#: From a scan's points (N, 3), map frame, its sensor's place (3,) and the map, what is contradicted.
Contradictions = Callable[[Points, Floats, PlacementSite], Contradicted]


def seen_through(points: Points, origin: Floats, site: PlacementSite) -> Contradicted:
    """Hold a scan and a map against each other: what one surely saw through, and no scan of it confirmed."""
    by_map = site.seen.verdicts(points)
    sights = Sights.of([(points, origin)])
    assert sights is not None  # of one scan there is always one
    by_scan = sights.verdicts(site.reference.points)
    return Contradicted(
        scan=(by_map.surely > 0) & (by_map.confirmed == 0),
        map=(by_scan.surely > 0) & (by_scan.confirmed == 0),
    )


def draw_impostors(
    answered: Sequence[Answered],
    settings: PlacementSettings,
    folder: Path,
    count: int,
    contradictions: Contradictions = seen_through,
) -> list[str]:
    """Write a picture of so many impostors, of every kind in turn, into `folder`; return the names of the files.

    One for which no pose is found at all is left out. Raises OSError.
    """
    names: list[str] = []
    for one in in_turn([one for one in answered if one.trial.impostor]):
        if len(names) == count:
            break
        site = load_site(one.trial.site, settings, folder)
        figure = _drawn(one, site, settings, contradictions)
        if figure is not None:
            names.append(f"impostor-{one.trial.name}.png")
            plots.save(figure, folder / names[-1])
    return names


def in_turn(answered: Sequence[Answered]) -> list[Answered]:
    """Order trials so that the first are of different rows of the table, and then of different places."""
    rows = sorted(answered, key=lambda one: one.trial.row)
    groups = [list(group) for _, group in groupby(rows, key=lambda one: one.trial.row)]
    ranked = [
        (place, row, group[(place + row) % len(group)])
        for row, group in enumerate(groups)
        for place in range(len(group))
    ]
    return [one for _, _, one in sorted(ranked, key=lambda item: item[:2])]


def best_pose(scan: PreparedScan, site: PlacementSite, settings: PipelineSettings) -> Matrix4 | None:
    """Return map_from_scan of the hypothesis that fits best, whether it would be accepted or not."""
    refinement = Refinement(
        source=scan.surface, target=site.reference.surface(), prior=None, settings=settings.registration
    )
    try:
        return global_registration(refinement, None).target_from_source
    except RegistrationFailed:
        return None


def _drawn(
    one: Answered, site: PlacementSite, settings: PlacementSettings, contradictions: Contradictions
) -> Figure | None:
    with TemporaryDirectory(prefix="spicd-placement-") as scratch:
        survey = simulate(one.trial, site, settings, Path(scratch))
        pipeline = settings.pipeline
        scan = survey.files[0].read(max_points=pipeline.max_scan_points)
    said = one.answer.scans[0]
    if said.pose is not None:
        pose: Matrix4 | None = np.array(said.pose).reshape(4, 4)
    else:
        pose = best_pose(prepare(scan, pipeline.registration), site, pipeline)
    if pose is None:
        return None
    placed = transformed(scan.points, pose).astype(np.float32)
    points = Voxels.of(placed, size=site.reference.voxel_size).points
    origin: Floats = (pose @ scan.sensor_pose)[:3, 3]
    return impostor_figure(
        f"{one.trial.site.name}: {one.trial.row}",
        _said(said),
        points,
        origin,
        site.reference.points,
        contradictions(points, origin, site),
    )


def impostor_figure(
    title: str, said: str, points: Points, origin: Floats, map_points: Points, contradicted: Contradicted
) -> Figure:
    """Draw the scan's points (N, 3) over the map's (M, 3), less floor and ceiling, and mark what is contradicted."""
    figure = Figure(figsize=(8, 7), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    low, high = np.percentile(map_points[:, 2], _SHARES)

    def body(of: Points) -> Bools:
        inside: Bools = (of[:, 2] > low + BODY[0]) & (of[:, 2] < high - BODY[1])
        return inside

    plots.draw_plan(axes, map_points[body(map_points)])
    shown = body(points)
    _dots(axes, points[shown & ~contradicted.scan], COLORS[0], 0.4)
    _dots(axes, map_points[body(map_points) & contradicted.map], MISSED, 1.0)
    _dots(axes, points[shown & contradicted.scan], WRONG, 1.0)
    axes.plot(origin[0], origin[1], "^", color=INK, markersize=7)
    plots.entitle(axes, f"{title}\n{said}")
    figure.legend(
        handles=_legend(contradicted), loc="outside lower center", ncols=2, fontsize=8, frameon=False
    )
    return figure


def _dots(axes: Axes, points: Points, color: str, size: float) -> None:
    axes.plot(points[:, 0], points[:, 1], ".", color=color, markersize=2 * size, markeredgewidth=0)


def _legend(contradicted: Contradicted) -> list[Line2D]:
    named = (
        ("s", "#999999", "map"),
        (".", COLORS[0], "scan, at the pose that fits best"),
        (".", WRONG, f"scan, where the map saw through ({contradicted.scan.mean():.1%} of its voxels)"),
        (".", MISSED, f"map, where the scan saw through ({contradicted.map.mean():.1%} of its voxels)"),
        ("^", INK, "sensor"),
    )
    return [
        Line2D([], [], marker=marker, color=color, linestyle="", label=label)
        for marker, color, label in named
    ]


def _said(said: ScanAnswer) -> str:
    named = f" ({', '.join(said.named)})" if said.named else ""
    believed = "believed" if said.verdict == "wrong" else said.verdict
    return f"{believed}{named}, fitness {said.fitness:.2f}" if said.fitness else f"{believed}{named}"
