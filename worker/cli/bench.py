"""`spicd-worker bench`, which is `make bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
    from worker.benchmarks.speed import BenchSettings, tables  # noqa: PLC0415
    from worker.benchmarks.speed import bench as run  # noqa: PLC0415

    settings = BenchSettings(scans=scans, repeats=repeats, model=model, model_store=model_store)
    with terminal.progress_bar() as progress:
        figures = run(settings, progress)
    write_json(out, figures)
    terminal.output().print(tables(figures), highlight=False)
    terminal.output().print(f"saved in {out}", highlight=False)
