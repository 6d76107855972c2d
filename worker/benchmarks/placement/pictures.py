"""Pictures of impostors: map and scan from above, at the pose that fits best, and what contradicts that pose."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from worker.benchmarks import plots
from worker.benchmarks.placement.answers import ScanAnswer
from worker.benchmarks.placement.measures import Answered
from worker.benchmarks.placement.plan import PlacementSettings
from worker.benchmarks.placement.sites import PlacementSite, load_site
from worker.benchmarks.placement.surveys import simulate
from worker.benchmarks.plots import COLORS, INK, MISSED, WRONG
from worker.cloud.types import Bools, Floats, Matrix4
from worker.errors import RegistrationFailed
from worker.pipeline.placement.contradictions import Held, Place, held_both_ways
from worker.pipeline.registration.preprocessing import PreparedScan, prepare
from worker.pipeline.registration.refinement import Refinement
from worker.pipeline.registration.scan_to_map import global_registration
from worker.pipeline.settings import PipelineSettings

EVERY = 1_000_000  #: points of each kind that are held against the other cloud: all that there are
BODY = (0.15, 0.25)  #: metres over the floor and under the ceiling that are left out, so that walls are seen
_SHARES = (1.0, 99.0)  # percent of the map's heights taken for floor and ceiling


def draw_impostors(
    answered: Sequence[Answered],
    settings: PlacementSettings,
    folder: Path,
    count: int,
) -> list[str]:
    """Write a picture of so many impostors, of every kind in turn, into `folder`; return the names of the files.

    One for which no pose is found at all is left out. Raises OSError.
    """
    names: list[str] = []
    for one in in_turn([one for one in answered if one.trial.impostor]):
        if len(names) == count:
            break
        site = load_site(one.trial.site, settings, folder)
        figure = _drawn(one, site, settings)
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


def _drawn(one: Answered, site: PlacementSite, settings: PlacementSettings) -> Figure | None:
    """Draw the first scan of a trial at the pose that it was given, or at the best one."""
    pipeline = settings.pipeline
    with TemporaryDirectory(prefix="spicd-placement-") as scratch:
        survey = simulate(one.trial, site, settings, Path(scratch))
        read = survey.files[0].read(max_points=pipeline.max_scan_points)
    try:
        scan = prepare(read, pipeline.registration, with_sights=True)
    except RegistrationFailed:
        return None
    said = one.answer.scans[0]
    pose = best_pose(scan, site, pipeline) if said.pose is None else np.array(said.pose).reshape(4, 4)
    if pose is None:
        return None
    place = Place(surface=site.reference.surface(), sights=site.seen.sights)
    held = held_both_ways(scan, place, pose, sample=EVERY)
    origin: Floats = (pose @ read.sensor_pose)[:3, 3]
    return impostor_figure(
        f"{one.trial.site.name}: {one.trial.row}", said, held, origin, place.surface.points
    )


def impostor_figure(
    title: str, said: ScanAnswer, held: tuple[Held, Held], origin: Floats, map_points: Floats
) -> Figure:
    """Draw the scan over the map's points (M, 3), less floor and ceiling, and mark what contradicts its pose."""
    figure = Figure(figsize=(8, 7.4), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    low, high = np.percentile(map_points[:, 2], _SHARES) + np.array([BODY[0], -BODY[1]])
    plots.draw_plan(axes, map_points[(map_points[:, 2] > low) & (map_points[:, 2] < high)].astype(np.float32))
    into_map, into_scan = held
    agrees = ~into_map.through & ~into_map.off
    for points, color, size in (
        (into_map.points[agrees], COLORS[0], 0.8),
        (into_map.points[into_map.off & ~into_map.through], COLORS[3], 1.6),
        (into_scan.points[into_scan.through], MISSED, 2.0),
        (into_map.points[into_map.through], WRONG, 2.0),
    ):
        shown = points[(points[:, 2] > low) & (points[:, 2] < high)]
        axes.plot(shown[:, 0], shown[:, 1], ".", color=color, markersize=size, markeredgewidth=0)
    axes.plot(origin[0], origin[1], "^", color=INK, markersize=7)
    plots.entitle(axes, f"{title}\n{_said(said)}")
    figure.legend(handles=_legend(held), loc="outside lower center", ncols=1, fontsize=8, frameon=False)
    return figure


def _legend(held: tuple[Held, Held]) -> list[Line2D]:
    into_map, into_scan = held
    off = f"scan, near the map's surfaces and off them ({_share(into_map.off, into_map.near)})"
    named = (
        ("s", "#999999", "map"),
        (".", COLORS[0], "scan, at the pose that fits best"),
        (".", WRONG, f"scan, where the map's rays went through ({_both(into_map)})"),
        (".", MISSED, f"map, where the scan's rays went through ({_both(into_scan)})"),
        (".", COLORS[3], off),
        ("^", INK, "sensor"),
    )
    return [
        Line2D([], [], marker=marker, color=color, linestyle="", label=label)
        for marker, color, label in named
    ]


def _both(held: Held) -> str:
    """Say how much of the building, and of the things in it, is contradicted, of what could be judged."""
    building, things = (
        _share(held.through & kind, held.judged & kind) for kind in (held.building, ~held.building)
    )
    return f"building {building}, things {things}"


def _share(part: Bools, whole: Bools) -> str:
    return f"{int(part.sum()) / max(int(whole.sum()), 1):.1%}"


def _said(said: ScanAnswer) -> str:
    named = f" ({', '.join(said.named)})" if said.named else ""
    believed = "believed" if said.verdict == "wrong" else said.verdict
    return f"{believed}{named}, fitness {said.fitness:.2f}" if said.fitness else f"{believed}{named}"
