"""The figures of `spicd-worker evaluate registration` as tables on a terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table


def tables(result: dict[str, Any]) -> Group:
    """A short table for each scenario, then the plain way, the survey and the real scans, as far as they were run."""
    parts: list[RenderableType] = [_scenario(row, result["paper"]) for row in result["scenarios"]]
    parts += [_plain(row) for row in result.get("plain", [])]
    if "survey" in result:
        parts.append(_survey(result["survey"]))
    if "real" in result:
        parts.append(_real(result["real"]))
    return Group(*parts)


def _titled(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", show_header=bool(columns))
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    return table


def _scenario(row: dict[str, Any], paper: dict[str, Any]) -> Table:
    report, seconds = row["report"], row["seconds"]
    table = _titled(f"{row['scenario']}, seed {row['seed']}", "", "measured", "the paper")
    table.add_row(
        "scans placed", f"{row['accepted']} of {row['of']}", f"{paper['accepted']} of {paper['scans']}"
    )
    if row["foreign"]:
        table.add_row(
            "scans of another building placed", f"{row['foreign_accepted']} of {row['foreign']}", ""
        )
    table.add_row("off the truth, median (worst)", _errors(row), "")
    table.add_row("placed, but over 10 cm off", str(row["wrong"]), "")
    table.add_row("within 2 sigma; median error / sigma", _calibration(row), "")
    table.add_row(
        "RMSE of accepted pairs", *(_of_pairs(each, "rmse", 100, 2, " cm") for each in (report, paper))
    )
    table.add_row(
        "fitness of accepted pairs", *(_of_pairs(each, "fitness", 1, 3) for each in (report, paper))
    )
    tried = f"{report['calls_saved']:.0%} ({report['pairs_tried']} of {report['pairs_possible']} tried)"
    table.add_row("ICP calls saved", tried, f"over {paper['calls_saved']:.0%}")
    graph = f"{report['pairs_accepted']}, {report['pairs_contradicted']}"
    table.add_row("pairs accepted, wrong loops thrown out", graph, "")
    stages = ", ".join(f"{stage} {time:.1f}" for stage, time in seconds.items() if stage != "total")
    processor = f"{seconds['total']:.1f} ({row['processor_seconds']:.1f} of processors)"
    table.add_row("seconds", processor, "")
    missing = f"left out: {', '.join(row['missing'])}" if row["missing"] else ""
    table.caption = "\n".join(line for line in (stages, missing) if line)
    return table


def _of_pairs(totals: dict[str, Any], what: str, factor: float, digits: int, unit: str = "") -> str:
    """Mean and deviation; nothing where no pair was accepted."""
    if totals[f"mean_{what}"] is None:
        return ""
    mean, deviation = (factor * totals[f"{word}_{what}"] for word in ("mean", "std"))
    return f"{mean:.{digits}f} ± {deviation:.{digits}f}{unit}"


def _errors(row: dict[str, Any]) -> str:
    if row["centimetres"] is None:
        return ""
    metres, degrees = row["centimetres"], row["degrees"]
    return (
        f"{metres['median']:.1f} ({metres['worst']:.1f}) cm, "
        f"{degrees['median']:.2f} ({degrees['worst']:.2f}) degrees"
    )


def _calibration(row: dict[str, Any]) -> str:
    said = [
        f"{words} {found['within_2_sigma']:.0%}; {found['median_error_over_sigma']:.2f}"
        for words, found in (("shift", row["translation_sigma"]), ("turn", row["rotation_sigma"]))
        if found is not None
    ]
    return ", ".join(said)


def _plain(row: dict[str, Any]) -> Table:
    gates = ", ".join(f"{100 * gate:g}" for gate in row["gates"])
    table = _titled(f"the plain way on the drifted scans, gates of {gates} cm")
    seconds, truth = row["seconds"], row["to_the_truth"]
    run = f"{row['pairs_run']} of {row['pairs_possible']} pairs run, {row['processor_seconds']:.0f} s of processors"
    extrapolated = "; the time of the others extrapolated" if row["pairs_run"] < row["pairs_possible"] else ""
    table.add_row("seconds", f"{seconds['total']:.0f}, {row['times_faster']:.1f} times ours")
    table.add_row("", run + extrapolated)
    table.add_row("scans placed", f"{row['accepted']}, {truth['wrong']} of them over 10 cm off")
    table.add_row("off the truth, median (worst)", _errors(truth))
    table.add_row("pairs accepted", f"{row['pairs_accepted']}, {row['pairs_wrong']} of them over 10 cm off")
    table.add_row("ours", f"{row['our_pairs']}, {row['our_pairs_wrong']} of them over 10 cm off")
    table.add_row("pairs of both, ours to theirs", _apart(row["common"]))
    table.add_row("those where theirs is right", _apart(row["common_right"]))
    return table


def _apart(found: dict[str, Any]) -> str:
    if not found["pairs"]:
        return "none"
    metres, degrees = found["centimetres"], found["degrees"]
    return (
        f"{found['pairs']} pairs: median {metres['median']:.2f} cm, {degrees['median']:.3f} degrees; "
        f"95% within {metres['95%']:.2f} cm, {degrees['95%']:.3f} degrees"
    )


def _survey(row: dict[str, Any]) -> Table:
    table = _titled(f"one scan of {row['points']:,} points on a warm map of {row['map_points']:,}")
    times = f"{row['register_seconds']:.2f} ({row['register_least']:.2f} to {row['register_most']:.2f})"
    table.add_row("seconds to register, median (least to most)", times)
    table.add_row("seconds of processors, reading too", f"{row['processor_seconds']:.2f}")
    table.add_row("seconds to read the file", f"{row['read_seconds']:.2f}")
    table.add_row("off the truth", f"{row['centimetres']:.1f} cm, {row['degrees']:.2f} degrees")
    return table


def _real(real: dict[str, Any]) -> Table:
    table = _titled(
        "real scans, no priors", "scans", "joined", "to the given transform", "fitness", "RMSE", "seconds"
    )
    for row in real["pairs"]:
        off = f"{row['centimetres']:.1f} cm, {row['degrees']:.2f} degrees" if row["joined"] else ""
        table.add_row(row["name"], "yes" if row["joined"] else "no", off, *_quality(row))
    frames = real["frames"]
    worst = (
        f"{frames['centimetres_worst']:.1f} cm, {frames['degrees_worst']:.2f} degrees (worst, to pairs alone)"
    )
    joined = f"{frames['accepted']} of {frames['frames']}"
    table.add_row(frames["name"], joined, worst, *_quality(frames))
    for row in real["foreign"]:
        verdict = "yes: wrong" if row["joined"] else "no"
        table.add_row(" + ".join(row["names"]), verdict, "not one place", *_quality(row))
    return table


def _quality(row: dict[str, Any]) -> tuple[str, str, str]:
    fitness, rmse = row.get("fitness"), row.get("rmse_centimetres")
    return (
        "" if fitness is None else f"{fitness:.2f}",
        "" if rmse is None else f"{rmse:.1f} cm",
        f"{row['seconds']:.1f}",
    )
