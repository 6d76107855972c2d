"""`spicd-worker train`: a training set from the simulator where there is none, then the network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from worker.cli import terminal
from worker.progress import Progress


def register(commands: typer.Typer) -> None:
    """Add `train` to the command line."""
    commands.command("train")(train)


def train(
    folder: Annotated[Path, typer.Argument(help="Checkpoints and log; a stopped training goes on there.")],
    paper: Annotated[
        bool, typer.Option("--paper", help="The paper's own pairs and start, where ours depart from them.")
    ] = False,
    tiles: Annotated[
        Path | None,
        typer.Option(help="Training set; left out: FOLDER/tiles.npz. Simulated where it is not there yet."),
    ] = None,
    offices: Annotated[int | None, typer.Option(min=0, help="Simulated offices of a new set.")] = None,
    corridors: Annotated[int | None, typer.Option(min=0, help="Simulated corridors.")] = None,
    rooms: Annotated[int | None, typer.Option(min=0, help="Simulated single rooms.")] = None,
    epochs: Annotated[int | None, typer.Option(min=0, help="At most so many.")] = None,
    minutes: Annotated[
        float | None, typer.Option(min=0, help="Wall clock of the training; the learning rate follows it.")
    ] = None,
    train_pairs: Annotated[int | None, typer.Option("--train-pairs", min=1, help="An epoch.")] = None,
    validation_pairs: Annotated[
        int | None, typer.Option("--validation-pairs", min=1, help="After each epoch.")
    ] = None,
    batch: Annotated[int | None, typer.Option(min=2, help="Pairs.")] = None,
    revisit_share: Annotated[
        float | None,
        typer.Option("--revisit-share", min=0, max=1, help="Of pairs of two visits, not one sampled twice."),
    ] = None,
    edited_share: Annotated[
        float | None,
        typer.Option("--edited-share", min=0, max=1, help="Of changed pairs, those of whole things."),
    ] = None,
    rebuilt_share: Annotated[
        float | None,
        typer.Option(
            "--rebuilt-share", min=0, max=1, help="Of changed pairs, those of a map with changed scans."
        ),
    ] = None,
    density: Annotated[
        tuple[float, float] | None, typer.Option(help="Least and largest share of points that changes take.")
    ] = None,
    start_from: Annotated[
        Path | None, typer.Option("--start-from", help="Checkpoint whose network is trained on.")
    ] = None,
    fresh_head: Annotated[
        bool | None, typer.Option("--fresh-head", help="Take its encoder alone, and start the head anew.")
    ] = None,
    head_epochs: Annotated[
        int | None,
        typer.Option("--head-epochs", min=0, help="Of the head alone, after the rest: seconds each."),
    ] = None,
    learning_rate: Annotated[
        float | None, typer.Option("--learning-rate", min=0, help="To begin with.")
    ] = None,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(envvar="SPICD_DEVICE")] = "auto",
    threads: Annotated[int | None, typer.Option(min=1, help="Of the CPU.")] = None,
) -> None:
    """Train SPICD-Net on simulated visits; what is left out keeps its default, which is the paper's where it has one."""
    # Not at the head of the file: torch takes seconds, which `--help` need not wait for.
    import torch  # noqa: PLC0415

    from worker.benchmarks.plots import draw_curves  # noqa: PLC0415
    from worker.detectors.store import resolve_device  # noqa: PLC0415
    from worker.training.settings import PAPER, TrainSettings  # noqa: PLC0415
    from worker.training.trainer import train as run  # noqa: PLC0415

    if threads is not None:
        torch.set_num_threads(threads)
    where = resolve_device(device).type
    default = PAPER if paper else TrainSettings()
    settings = replace(
        default,
        device=where,
        coarse_search=where == "cpu",
        pairs=replace(
            default.pairs,
            **_given(
                revisit_share=revisit_share,
                edited_share=edited_share,
                rebuilt_share=rebuilt_share,
                density=density,
            ),
        ),
        **_given(
            epochs=epochs,
            minutes=minutes,
            train_pairs=train_pairs,
            validation_pairs=validation_pairs,
            batch=batch,
            learning_rate=learning_rate,
            fresh_head=fresh_head,
            head_epochs=head_epochs,
            start_from=None if start_from is None else str(start_from),
        ),
    )
    tiles = tiles or folder / "tiles.npz"
    buildings = _given(offices=offices, corridors=corridors, rooms=rooms)
    with terminal.progress_bar() as progress:
        _make_tiles(tiles, buildings, progress)
        best = run(settings, tiles, folder, progress, on_epoch=draw_curves)
    terminal.output().print(
        f"{best}\n`python -m worker.training.publish {best} {tiles}` makes a model of it", highlight=False
    )


def _make_tiles(path: Path, buildings: dict[str, Any], progress: Progress) -> None:
    """Simulate a training set, unless there is one. Raises ValueError where buildings are asked of one that is."""
    from worker.simulation.training_set import TrainingSetSettings, build_training_set  # noqa: PLC0415
    from worker.training.dataset import save_tiles  # noqa: PLC0415

    if not path.exists():
        save_tiles(build_training_set(TrainingSetSettings.model_validate(buildings), progress), path)
    elif buildings:
        raise ValueError(
            f"{path} is there already; name another with --tiles, or leave out {', '.join(buildings)}"
        )


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}
