"""`spicd-worker bench`, which is `make bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.table import Table

from worker.cli import terminal
from worker.cli.options import DEFAULT_MODEL, Model, ModelStore
from worker.detectors.card import MODEL_STORE


def register(commands: typer.Typer) -> None:
    """Add `bench` to the command line."""
    commands.command("bench")(bench)


def bench(
    out: Annotated[Path, typer.Option(help="Where the figures are saved.")] = Path("bench/bench.json"),
    scans: Annotated[int, typer.Option(min=2, help="Of the simulated corridor's map.")] = 25,
    repeats: Annotated[int, typer.Option(min=1, help="Of each way of scoring.")] = 3,
    model: Model = DEFAULT_MODEL,
    model_store: ModelStore = MODEL_STORE,
) -> None:
    """Seconds in each stage of a map and of a survey on a simulated corridor, and what scoring costs."""
    # Not at the head of the file: torch and Open3D take seconds, which `--help` need not wait for.
    from worker.benchmarks.documents import write_json  # noqa: PLC0415
    from worker.benchmarks.speed import BenchSettings  # noqa: PLC0415
    from worker.benchmarks.speed import bench as run  # noqa: PLC0415

    settings = BenchSettings(scans=scans, repeats=repeats, model=model, model_store=model_store)
    with terminal.progress_bar() as progress:
        figures = run(settings, progress)
    write_json(out, figures)
    terminal.output().print(_tables(figures), highlight=False)
    terminal.output().print(f"saved in {out}", highlight=False)


def _tables(figures: dict[str, Any]) -> Group:
    scene, poses = figures["scene"], figures["map_poses"]
    title = f"{scene['scans']} scans of {scene['points_per_scan']:,} points, {scene['tiles']} tiles"
    stages = Table(title=title, title_justify="left")
    stages.add_column("stage")
    for column in ("map", "survey, drifted prior", "survey, no prior"):
        stages.add_column(column, justify="right")
    columns = [figures["map"], figures["survey_with_prior"], figures["survey_without_prior"]]
    names = [name for name in dict.fromkeys(name for column in columns for name in column) if name != "total"]
    for name in [*(name for name in names if _is_time(columns, name)), "total"]:
        stages.add_row(name, *(_seconds(column.get(name)) for column in columns))
    return Group(
        stages,
        _scoring_table(figures["network"]),
        f"scans placed: {poses['accepted']} of {poses['of']}, off by {poses['centimetres']['median']:.1f} cm "
        f"(most {poses['centimetres']['most']:.1f}) and {poses['degrees']['median']:.2f} degrees "
        f"(most {poses['degrees']['most']:.2f})",
        f"peak memory {figures['peak_memory_mb']} MB",
    )


def _scoring_table(scoring: dict[str, Any]) -> Table:
    points = scoring["distinct_points_per_tile"]
    table = Table(title=f"{scoring['tiles']} tiles, {points} distinct points each", title_justify="left")
    table.add_column("scoring")
    for column in ("seconds (median)", "least to most", "times C2C"):
        table.add_column(column, justify="right")
    names = {"c2c": "C2C by k-d tree", "uncached": "detector", "cached": "detector, map encoded before"}
    for name, spread in scoring["seconds"].items():
        table.add_row(
            names[name],
            f"{spread['median']:.2f}",
            f"{spread['least']:.2f} to {spread['most']:.2f}",
            f"{scoring['times_c2c'][name]:.1f}",
        )
    table.caption = (
        f"largest difference between the detector's scores: {scoring['largest_score_difference']:.1e}"
    )
    return table


def _is_time(columns: list[dict[str, Any]], name: str) -> bool:
    return any(isinstance(column.get(name), float) for column in columns)


def _seconds(value: Any) -> str:
    return f"{value:.2f} s" if isinstance(value, float) else ""
