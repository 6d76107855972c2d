"""`spicd-worker publish`: a model of what `spicd-worker train` has trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from worker.cli import terminal
from worker.cli.options import ModelStore
from worker.detectors.card import MODEL_STORE


def publish(
    folder: Annotated[
        Path, typer.Argument(help="Folder of a training: its best checkpoint becomes the model.")
    ],
    model: Annotated[str, typer.Option(help="name/version of the new model, as in pointnet2/2.")],
    model_store: ModelStore = MODEL_STORE,
    tiles: Annotated[
        Path | None, typer.Option(help="Training set that it was trained on; left out: FOLDER/tiles.npz.")
    ] = None,
    unseen: Annotated[
        Path | None, typer.Option(help="Training set of other buildings, to measure on; left out: none.")
    ] = None,
    summary: Annotated[str | None, typer.Option(help="What the card says of it in a sentence.")] = None,
    stands_on: Annotated[
        str | None,
        typer.Option(
            help="Model of the store (name/version) whose encoder it has; its weights are not stored again."
        ),
    ] = None,
) -> None:
    """Make a model of a training: choose its threshold on the validation tiles, and write weights and card."""
    name, version = new_model(model_store, model)
    # Not at the head of the file: torch takes seconds, which `--help` need not wait for.
    from worker.detectors.store import open_detector  # noqa: PLC0415
    from worker.training.publish import publish as write  # noqa: PLC0415
    from worker.training.trainer import BEST  # noqa: PLC0415

    with terminal.progress_bar() as progress:
        progress("scoring validation pairs", 0.0)
        written = write(
            folder / BEST,
            tiles or folder / "tiles.npz",
            model_store,
            name=name,
            version=version,
            unseen=unseen,
            summary=summary,
            stands_on=None if stands_on is None else open_detector(model_store, stands_on, "cpu"),
        )
    terminal.output().print(
        f"{written}\nopen it as --model {model} --model-store {model_store}", highlight=False
    )


def new_model(model_store: Path, model: str) -> tuple[str, str]:
    """Return name and version of a model that is to be written. Raises ValueError where it is there, or is no name."""
    name, slash, version = model.partition("/")
    if not (name and slash and version) or "/" in version or {name, version} & {".", ".."}:
        raise ValueError(f"--model {model}: name and version are wanted, as in pointnet2/2")
    if (model_store / model).exists():
        free = f"{name}/{next_version(model_store, name)}"
        raise ValueError(f"model {model} is in {model_store} already; give another version, as {free}")
    return name, version


def next_version(model_store: Path, name: str) -> str:
    """Return the number after the largest that a model of this name has in the store; 1 for the first."""
    numbers = [int(folder.name) for folder in (model_store / name).glob("*") if folder.name.isdigit()]
    return str(max(numbers, default=0) + 1)
