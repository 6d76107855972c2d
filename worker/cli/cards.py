"""`spicd-worker evaluate speed`, `record` and `table`: all models side by side, and what their cards say of them.

What a command needs of the benchmarks is imported within it, as in `evaluate`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from worker.cli import terminal
from worker.cli.command_line import command_line
from worker.cli.options import DEFAULT_MODEL, Model, ModelStore
from worker.detectors.card import MODEL_STORE

PAGE = Path("docs/comparison.md")  #: of a checkout


def speed(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Where the figures are saved.")] = Path("bench/speed.json"),
    repeats: Annotated[int, typer.Option(min=1, help="Of each way of scoring.")] = 3,
    scans: Annotated[int, typer.Option(min=2, help="Of the simulated corridor's map.")] = 25,
    model_store: ModelStore = MODEL_STORE,
) -> None:
    """Time all models of the store and the baselines in one run, on 172 tiles of a simulated corridor."""
    from worker.benchmarks.detector_speed import SpeedSettings, measure, tables  # noqa: PLC0415
    from worker.benchmarks.documents import write_json  # noqa: PLC0415

    settings = SpeedSettings(scans=scans, repeats=repeats, model_store=model_store)
    with terminal.progress_bar() as progress:
        result = {"command": command_line(context), **measure(settings, progress)}
    write_json(out, result)
    terminal.show(result, tables, f"saved in {out}")


def record(
    paper: Annotated[Path | None, typer.Option(help="paper.json of `evaluate paper`.")] = None,
    revisit: Annotated[Path | None, typer.Option(help="revisit.json of `evaluate revisit`.")] = None,
    real: Annotated[Path | None, typer.Option(help="real.json of `evaluate real`.")] = None,
    speed: Annotated[Path | None, typer.Option(help="speed.json of `evaluate speed`.")] = None,
    model: Model = DEFAULT_MODEL,
    model_store: ModelStore = MODEL_STORE,
) -> None:
    """Put the figures of the benchmarks on a model's card; refused where they were measured with other weights."""
    from worker.benchmarks.card_figures import record_figures  # noqa: PLC0415

    given = {"paper": paper, "revisit": revisit, "real": real, "speed": speed}
    files = {name: path for name, path in given.items() if path is not None}
    if not files:
        raise ValueError("nothing to record: give --paper, --revisit, --real or --speed")
    path = record_figures(model_store, model, files)
    terminal.output().print(f"{path}: {', '.join(files)}", highlight=False)


def table(
    page: Annotated[Path, typer.Option(help="The document whose table is written anew.")] = PAGE,
    model_store: ModelStore = MODEL_STORE,
    check: Annotated[
        bool,
        typer.Option("--check", help="Write nothing; fail where the document is not what the cards say."),
    ] = False,
) -> None:
    """Set all detectors side by side, from what their cards say: the table of docs/comparison.md and its pictures."""
    from worker.benchmarks.table import measured, write_table  # noqa: PLC0415
    from worker.benchmarks.table_pictures import write_pictures  # noqa: PLC0415

    changed = write_table(page, model_store, check=check)
    if not check:
        write_pictures(page.parent / "pictures", measured(model_store), model_store)
    terminal.output().print(f"{page}: {'written' if changed else 'up to date'}", highlight=False)
