"""`spicd-worker evaluate`: the benchmarks, each a command of its own, and one that puts their figures on a card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from worker.cli import evaluate_paper, evaluate_record, evaluate_revisit, terminal


def register(commands: typer.Typer) -> None:
    """Add `evaluate` and its commands to the command line."""
    group = typer.Typer(
        name="evaluate", no_args_is_help=True, help="How good it is, measured where the truth is known."
    )
    group.command("registration")(registration)
    evaluate_paper.register(group)
    evaluate_revisit.register(group)
    evaluate_record.register(group)
    commands.add_typer(group)


def registration(
    seeds: Annotated[str, typer.Option(help="Of the simulated buildings and walks, with commas.")] = "1",
    scenarios: Annotated[
        str, typer.Option(help="Of drifted, lost, drifted+foreign, lost+foreign, with commas; or none.")
    ] = "drifted,lost,drifted+foreign,lost+foreign",
    building: Annotated[
        Literal["loop", "room"], typer.Option(help="A corridor with a loop, or one room.")
    ] = "loop",
    scans: Annotated[int, typer.Option(min=2, help="Stops of the walk.")] = 42,
    foreign: Annotated[int, typer.Option(min=1, max=17, help="Scans of another building.")] = 5,
    standing: Annotated[float, typer.Option(min=0.1, help="Seconds at each stop.")] = 5.0,
    plain: Annotated[
        bool, typer.Option("--plain", help="Also all pairs in one process with Open3D's ICP: minutes.")
    ] = False,
    plain_pairs: Annotated[
        int | None,
        typer.Option("--plain-pairs", min=1, help="So many random pairs, the rest of the time extrapolated."),
    ] = None,
    survey: Annotated[bool, typer.Option(help="Also time one scan against the first map.")] = True,
    real: Annotated[Path | None, typer.Option(help="Folder of real scans: see docs/simulator.md.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for registration.json and pictures.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Figures as JSON on stdout.")] = False,
) -> None:
    """Build maps from simulated walks, with and without priors and strangers, and hold them against the truth."""
    # Not at the head of the file: Open3D and Matplotlib take seconds, which `--help` need not wait for.
    from worker.benchmarks.registration.benchmark import BenchmarkSettings, evaluate  # noqa: PLC0415
    from worker.benchmarks.registration.scenario import WalkSettings, kinds_named  # noqa: PLC0415
    from worker.benchmarks.registration.tables import tables  # noqa: PLC0415

    settings = BenchmarkSettings(
        walk=WalkSettings(building=building, scans=scans, foreign=foreign, duration_s=standing),
        seeds=_numbers(seeds),
        kinds=kinds_named(scenarios),
        plain=plain or plain_pairs is not None,
        plain_pairs=plain_pairs,
        survey=survey,
        real=real,
        out=out,
    )
    with terminal.progress_bar() as progress:
        result = evaluate(settings, progress)
    if out is not None:
        _save(result, out / "registration.json")
    if as_json:
        terminal.print_json(result)
    else:
        terminal.output().print(tables(result), highlight=False)


def _numbers(words: str) -> tuple[int, ...]:
    """Raises ValueError for what is no list of numbers."""
    try:
        return tuple(int(word) for word in words.split(","))
    except ValueError:
        raise ValueError(f"--seeds {words}: give whole numbers with commas, as in 1,2,3") from None


def _save(figures: dict[str, Any], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".tmp")
    aside.write_text(json.dumps(figures, indent=2) + "\n")
    aside.replace(path)
