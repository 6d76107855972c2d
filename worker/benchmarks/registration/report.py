"""The figures of `spicd-worker evaluate registration` as tables on a terminal, and two pictures of each map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.console import Group, RenderableType
from rich.table import Table

from worker.benchmarks import plots
from worker.benchmarks.documents import Document, shown, titled_table
from worker.benchmarks.plots import FOUND, INK, MISSED, WRONG
from worker.benchmarks.registration.assessment import Assessment
from worker.benchmarks.registration.scenarios import Scenario
from worker.cloud.poses import inverse
from worker.cloud.types import Floats
from worker.pipeline.flow import BuiltMap

_BODY = (0.15, 2.0)  # metres above the floor: what is drawn of the map
_WIDEST, _HIGHEST, _NARROWEST = 10.0, 9.0, 6.5  # inches


def tables(result: Document) -> Group:
    """Show a short table for each scenario, then baseline, survey and real scans as far as they were run."""
    parts: list[RenderableType] = [_scenario(row, result["paper"]) for row in result["scenarios"]]
    parts += [_baseline(row) for row in result.get("plain", [])]
    if "survey" in result:
        parts.append(_survey(result["survey"]))
    if "real" in result:
        parts.append(_real(result["real"]))
    return Group(*parts)


def _scenario(row: Document, paper: Document) -> Table:
    report, seconds = row["report"], row["seconds"]
    placed = [f"{totals['accepted']} of {totals['of']}" for totals in (row, paper | {"of": paper["scans"]})]
    tried = f"{report['calls_saved']:.0%} ({report['pairs_tried']} of {report['pairs_possible']} tried)"
    foreign = ("scans of another building placed", f"{row['foreign_accepted']} of {row['foreign']}")
    rows = (
        ("scans placed", *placed),
        *([foreign] if row["foreign"] else []),
        ("off the truth, median (worst)", _errors(row)),
        ("placed, but over 10 cm off", str(row["wrong"])),
        ("within 2 sigma; median error / sigma", _calibration(row)),
        ("RMSE of accepted pairs", *(_of_pairs(totals, "rmse", 100, 2, " cm") for totals in (report, paper))),
        ("fitness of accepted pairs", *(_of_pairs(totals, "fitness", 1, 3) for totals in (report, paper))),
        ("ICP calls saved", tried, f"over {paper['calls_saved']:.0%}"),
        ("pairs accepted, wrong loops thrown out", f"{report['pairs_accepted']}, {report['pairs_contradicted']}"),
        ("seconds", f"{seconds['total']:.1f} ({row['processor_seconds']:.1f} of processors)"),
    )  # fmt: skip
    stages = ", ".join(f"{stage} {time:.1f}" for stage, time in seconds.items() if stage != "total")
    missing = f"left out: {', '.join(row['missing'])}" if row["missing"] else ""
    caption = "\n".join(line for line in (stages, missing) if line)
    title = f"{row['scenario']}, seed {row['seed']}"
    return titled_table(title, ("", "measured", "the paper"), rows, caption=caption)


def _of_pairs(totals: Document, what: str, factor: float, digits: int, unit: str = "") -> str:
    """Write mean and deviation; nothing where no pair was accepted."""
    if totals[f"mean_{what}"] is None:
        return ""
    mean, deviation = (factor * totals[f"{word}_{what}"] for word in ("mean", "std"))
    return f"{mean:.{digits}f} ± {deviation:.{digits}f}{unit}"


def _errors(row: Document) -> str:
    if row["centimetres"] is None:
        return ""
    metres, degrees = row["centimetres"], row["degrees"]
    return (
        f"{metres['median']:.1f} ({metres['worst']:.1f}) cm, "
        f"{degrees['median']:.2f} ({degrees['worst']:.2f}) degrees"
    )


def _calibration(row: Document) -> str:
    return ", ".join(
        f"{name} {sigma['within_2_sigma']:.0%}; {sigma['median_error_over_sigma']:.2f}"
        for name, sigma in (("shift", row["translation_sigma"]), ("turn", row["rotation_sigma"]))
        if sigma is not None
    )


def _baseline(row: Document) -> Table:
    distances = ", ".join(f"{100 * distance:g}" for distance in row["gates"])
    seconds, truth = row["seconds"], row["to_the_truth"]
    run = f"{row['pairs_run']} of {row['pairs_possible']} pairs run, {row['processor_seconds']:.0f} s of processors"
    extrapolated = "; the time of the others extrapolated" if row["pairs_run"] < row["pairs_possible"] else ""
    rows = (
        ("seconds", f"{seconds['total']:.0f}, {row['times_faster']:.1f} times ours"),
        ("", run + extrapolated),
        ("scans placed", f"{row['accepted']}, {truth['wrong']} of them over 10 cm off"),
        ("off the truth, median (worst)", _errors(truth)),
        ("pairs accepted", f"{row['pairs_accepted']}, {row['pairs_wrong']} of them over 10 cm off"),
        ("ours", f"{row['our_pairs']}, {row['our_pairs_wrong']} of them over 10 cm off"),
        ("pairs of both, ours to theirs", _apart(row["common"])),
        ("those where theirs is right", _apart(row["common_right"])),
    )
    title = f"the Open3D baseline on the drifted scans, correspondences within {distances} cm"
    return titled_table(title, (), rows)


def _apart(row: Document) -> str:
    if not row["pairs"]:
        return "none"
    metres, degrees = row["centimetres"], row["degrees"]
    return (
        f"{row['pairs']} pairs: median {metres['median']:.2f} cm, {degrees['median']:.3f} degrees; "
        f"95% within {metres['95%']:.2f} cm, {degrees['95%']:.3f} degrees"
    )


def _survey(row: Document) -> Table:
    times = f"{row['register_seconds']:.2f} ({row['register_least']:.2f} to {row['register_most']:.2f})"
    rows = (
        ("seconds to register, median (least to most)", times),
        ("seconds of processors, reading too", f"{row['processor_seconds']:.2f}"),
        ("seconds to read the file", f"{row['read_seconds']:.2f}"),
        ("off the truth", f"{row['centimetres']:.1f} cm, {row['degrees']:.2f} degrees"),
    )
    title = f"one scan of {row['points']:,} points on a warm map of {row['map_points']:,}"
    return titled_table(title, (), rows)


def _real(real: Document) -> Table:
    frames = real["frames"]
    worst = (
        f"{frames['centimetres_worst']:.1f} cm, {frames['degrees_worst']:.2f} degrees (worst, to pairs alone)"
    )
    rows = [
        (
            row["name"],
            "yes" if row["joined"] else "no",
            f"{row['centimetres']:.1f} cm, {row['degrees']:.2f} degrees" if row["joined"] else "",
            *_quality(row),
        )
        for row in real["pairs"]
    ]
    rows.append((frames["name"], f"{frames['accepted']} of {frames['frames']}", worst, *_quality(frames)))
    for row in real["foreign"]:
        verdict = "yes: wrong" if row["joined"] else "no"
        rows.append((" + ".join(row["names"]), verdict, "not one place", *_quality(row)))
    columns = ("scans", "joined", "to the given transform", "fitness", "RMSE", "seconds")
    return titled_table("real scans, no priors", columns, rows)


def _quality(row: Document) -> tuple[str, str, str]:
    rmse = shown(row.get("rmse_centimetres"), ".1f", unit=" cm")
    return shown(row.get("fitness"), ".2f"), rmse, f"{row['seconds']:.1f}"


def draw_run(folder: Path, scenario: Scenario, seed: int, built: BuiltMap, assessment: Assessment) -> None:
    """Write `map-KIND-SEED.png` and `errors-KIND-SEED.png` into the folder. Raises OSError."""
    title = f"{scenario.kind}, seed {seed}: {len(assessment.errors)} of {assessment.scans} scans"
    name = f"{scenario.kind}-{seed}.png"
    plots.save(_pose_graph(scenario, built, assessment, title), folder / f"map-{name}")
    plots.save(_error_bars(assessment, title), folder / f"errors-{name}")


def _pose_graph(scenario: Scenario, built: BuiltMap, assessment: Assessment, title: str) -> Figure:
    """Draw the pose graph from above, over the walls."""
    points = built.reference.points
    width, height = np.ptp(points[:, :2], axis=0) + 2 * plots.BEYOND
    scale = min(_WIDEST / width, _HIGHEST / height)
    size = (max(width * scale, _NARROWEST) + 0.8, height * scale + 1.4)
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    axes = figure.add_subplot()
    above = points[:, 2] - np.percentile(points[:, 2], 1)
    plots.draw_plan(axes, points[(above > _BODY[0]) & (above < _BODY[1])])
    places = _places(scenario, built, assessment)
    _draw_edges(axes, built, places)
    _draw_stops(axes, scenario, built, places)
    plots.entitle(axes, title)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _places(scenario: Scenario, built: BuiltMap, assessment: Assessment) -> dict[int, Floats]:
    """Return (3,) by index: where the map has a scan; where it was in truth for one of the building that is missing."""
    places: dict[int, Floats] = {}
    for scan, (outcome, true) in enumerate(zip(built.outcomes, scenario.true, strict=True)):
        if outcome.registration:
            places[scan] = outcome.registration.map_from_scan[:3, 3]
        elif true is not None and assessment.true_from_map is not None:
            places[scan] = (inverse(assessment.true_from_map) @ true)[:3, 3]
    return places


def _draw_edges(axes: Axes, built: BuiltMap, places: dict[int, Floats]) -> None:
    for pairs, color, order in ((built.kept, FOUND, 2), (built.rejected, WRONG, 3)):
        for pair in pairs:
            if pair.target in places and pair.source in places:
                ends = np.stack([places[pair.target], places[pair.source]])
                axes.plot(ends[:, 0], ends[:, 1], color=color, linewidth=0.9, alpha=0.7, zorder=order)


def _draw_stops(axes: Axes, scenario: Scenario, built: BuiltMap, places: dict[int, Floats]) -> None:
    for scan, place in places.items():
        missing, out_of_place = built.outcomes[scan].registration is None, scenario.true[scan] is None
        color = MISSED if missing else WRONG if out_of_place else INK
        marker = "x" if missing or out_of_place else "o"
        axes.plot(place[0], place[1], marker, color=color, markersize=5, zorder=4)
        axes.annotate(
            built.outcomes[scan].name.removeprefix("stop-"),
            (float(place[0]), float(place[1])),
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=6,
            color=color,
            zorder=5,
        )


def _legend() -> list[Line2D]:
    lines = ((FOUND, "pair that was kept"), (WRONG, "thrown out as a wrong loop"))
    marks = (
        ("o", INK, "stop"),
        ("x", MISSED, "left out, drawn where it truly was"),
        ("x", WRONG, "of another building, and yet placed"),
    )
    return [
        *(Line2D([], [], color=color, label=name) for color, name in lines),
        *(
            Line2D([], [], marker=marker, color=color, linestyle="", markersize=5, label=name)
            for marker, color, name in marks
        ),
    ]


def _error_bars(assessment: Assessment, title: str) -> Figure:
    """Draw each scan's error against its sigma."""
    rows = assessment.document()["scans"]
    figure = Figure(figsize=(max(6.0, 0.24 * len(rows) + 1.5), 5.0), dpi=120, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    plots.entitle(above, title)
    _draw_errors(above, rows, "centimetres", "off the truth (cm)")
    _draw_errors(below, rows, "degrees", "off the truth (degrees)")
    below.tick_params(axis="x", rotation=90)
    handles = [*above.get_legend_handles_labels()]
    figure.legend(*handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _draw_errors(axes: Axes, rows: list[Document], unit: str, name: str) -> None:
    """Draw what sigma speaks of, the error seen from the reference scan, and the error after the best fit of all."""
    seen, sigma = (
        np.array([np.nan if row[prefix + unit] is None else row[prefix + unit] for row in rows])
        for prefix in ("from_reference_", "sigma_")
    )
    scans = [row["name"].removeprefix("stop-") for row in rows]
    plots.draw_bars(axes, scans, {"error, seen from the reference scan": seen})
    places = np.arange(len(rows))
    axes.plot(places, 2 * sigma, "_", color=WRONG, markersize=7, label="twice the sigma of that")
    axes.plot(places, [row[unit] for row in rows], ".", color=INK, markersize=4, label="error, frames fitted")
    plots.label(axes, "", name, legend=False)
