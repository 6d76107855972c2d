"""`spicd-worker train`: a training set from the simulator where there is none, then the network."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from worker.cli import terminal
from worker.cli.options import Device
from worker.progress import Progress
from worker.training.options import OPTIONS, Option, with_options


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
    rebuilds: Annotated[
        int | None,
        typer.Option(
            min=0, help="Maps of each building of a new set that are fused anew with some scans changed."
        ),
    ] = None,
    device: Device = "auto",
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the CPU.")] = None,
    **options: Any,
) -> None:
    """Train a network of tiles on simulated visits; what is left out keeps its default, the paper's where it has one.

    Without --minutes or --epochs it takes up to 1,000 epochs of about two minutes each on two cores.
    """
    # Not at the head of the file: torch takes seconds, which `--help` need not wait for.
    import torch  # noqa: PLC0415

    from worker.benchmarks.plots import draw_curves  # noqa: PLC0415
    from worker.detectors.store import resolve_device  # noqa: PLC0415
    from worker.training.settings import PAPER, TrainSettings  # noqa: PLC0415
    from worker.training.trainer import train as run  # noqa: PLC0415

    if threads is not None:
        torch.set_num_threads(threads)
    settings = with_options(PAPER if paper else TrainSettings(), options, device=resolve_device(device).type)
    tiles = tiles or folder / "tiles.npz"
    asked = {"offices": offices, "corridors": corridors, "rooms": rooms}
    buildings: dict[str, Any] = {name: count for name, count in asked.items() if count is not None}
    if rebuilds is not None:
        buildings["walks"] = {"rebuilds": rebuilds}
    with terminal.progress_bar() as progress:
        _make_tiles(tiles, buildings, progress)
        best = run(settings, tiles, folder, progress, on_epoch=draw_curves)
    terminal.output().print(
        f"{best}\nmake a model of it: spicd-worker publish {folder}{_of(tiles, folder)} --model NAME/VERSION",
        highlight=False,
    )


def _of(tiles: Path, folder: Path) -> str:
    return "" if tiles == folder / "tiles.npz" else f" --tiles {tiles}"


def with_training_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with its `**options` spelled out in the signature, which Typer reads."""
    signature = inspect.signature(command, eval_str=True)
    own = [parameter for name, parameter in signature.parameters.items() if name != "options"]
    added = [_parameter(option) for option in OPTIONS]

    @functools.wraps(command)
    def spelled_out(**values: Any) -> None:
        command(**values)

    spelled_out.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *added)}
    spelled_out.__signature__ = signature.replace(parameters=[*own, *added])  # type: ignore[attr-defined]
    return spelled_out


def _parameter(option: Option) -> inspect.Parameter:
    kind = tuple[(option.kind,) * option.count] if option.count > 1 else option.kind  # type: ignore[misc]
    given = typer.Option(option.flag, help=option.help, min=option.least, max=option.most)
    return inspect.Parameter(
        option.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind | None, given]
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
