"""`spicd-worker bench`, which is `make bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.table import Table

from worker.cli import terminal
from worker.detectors.card import MODEL_STORE


def register(commands: typer.Typer) -> None:
    """Add `bench` to the command line."""
    commands.command("bench")(bench)


def bench(
    out: Annotated[Path, typer.Option(help="Where the figures are saved.")] = Path("bench/bench.json"),
    scans: Annotated[int, typer.Option(min=2, help="Of the simulated corridor's map.")] = 25,
    repeats: Annotated[int, typer.Option(min=1, help="Of each way of running the network.")] = 3,
    model: Annotated[str, typer.Option(envvar="SPICD_MODEL", help="name/version")] = "spicd-net/1",
    model_store: Annotated[
        Path, typer.Option("--model-store", envvar="SPICD_MODEL_STORE", help="Folder of the models.")
    ] = MODEL_STORE,
) -> None:
    """Seconds in each stage of a map and of a survey on a simulated corridor, and what the network costs."""
    # Not at the head of the file: torch and Open3D take seconds, which `--help` need not wait for.
    from worker.benchmarks.speed import BenchSettings, save  # noqa: PLC0415
    from worker.benchmarks.speed import bench as run  # noqa: PLC0415

    settings = BenchSettings(scans=scans, repeats=repeats, model=model, model_store=model_store)
    with terminal.progress_bar() as progress:
        figures = run(settings, progress)
    save(figures, out)
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
        _network_table(figures["network"]),
        f"scans placed: {poses['accepted']} of {poses['of']}, off by {poses['centimetres']['median']:.1f} cm "
        f"(most {poses['centimetres']['most']:.1f}) and {poses['degrees']['median']:.2f} degrees "
        f"(most {poses['degrees']['most']:.2f})",
        f"peak memory {figures['peak_memory_mb']} MB",
    )


def _network_table(network: dict[str, Any]) -> Table:
    points = network["distinct_points_per_tile"]
    table = Table(title=f"{network['tiles']} tiles, {points} distinct points each", title_justify="left")
    table.add_column("network")
    for column in ("seconds (median)", "least to most", "times faster than uncached"):
        table.add_column(column, justify="right")
    for name, spread in network["seconds"].items():
        table.add_row(
            name.replace("_", ", "),
            f"{spread['median']:.2f}",
            f"{spread['least']:.2f} to {spread['most']:.2f}",
            f"{network['times_faster_than_uncached'][name]:.1f}",
        )
    table.caption = f"largest difference between scores: {network['largest_score_difference']:.1e}"
    return table


def _is_time(columns: list[dict[str, Any]], name: str) -> bool:
    return any(isinstance(column.get(name), float) for column in columns)


def _seconds(value: Any) -> str:
    return f"{value:.2f} s" if isinstance(value, float) else ""
