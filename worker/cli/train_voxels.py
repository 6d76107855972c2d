"""`spicd-worker train-voxels`: samples from the simulator where there are none, both networks, and the model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from worker.cli import terminal
from worker.cli.publish import new_model, next_version
from worker.detectors.card import MODEL_STORE

SUMMARY = (
    "A sparse U-Net on what both visits saw of each 5 cm voxel, one network for both directions: what the survey hit "
    "and the map's scans saw through has appeared, what the map has and the survey saw through has disappeared."
)


def train_voxels(
    folder: Annotated[
        Path, typer.Argument(help="Samples, checkpoints and logs; a stopped training goes on there.")
    ],
    store: Annotated[
        Path, typer.Option(help="Where the model is written, as voxel-net/VERSION.")
    ] = MODEL_STORE,
    version: Annotated[
        str | None,
        typer.Option(help="Version of the model; left out: the next number that the store has not."),
    ] = None,
    offices: Annotated[int, typer.Option(min=0, help="Simulated offices of a new set of samples.")] = 12,
    corridors: Annotated[int, typer.Option(min=0, help="Simulated corridors.")] = 8,
    rooms: Annotated[int, typer.Option(min=0, help="Simulated single rooms.")] = 24,
    epochs: Annotated[
        int, typer.Option(min=1, help="Of 100 steps, for clouds with their sensors' places.")
    ] = 20,
    blind_epochs: Annotated[int, typer.Option(min=1, help="Of 100 steps, for clouds without.")] = 6,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the CPU.")] = None,
) -> None:
    """Train the voxel network on simulated visits and publish it (about 40 minutes on two cores, all in all)."""
    # Not at the head of the file: torch takes seconds, which `--help` need not wait for.
    import torch  # noqa: PLC0415

    from worker.simulation.voxel_samples import VoxelSampleSettings, make_samples  # noqa: PLC0415
    from worker.training.voxels.publish import publish  # noqa: PLC0415
    from worker.training.voxels.samples import load_samples  # noqa: PLC0415
    from worker.training.voxels.trainer import VoxelTrainSettings, train_networks  # noqa: PLC0415

    if version is None:
        version = next_version(store, "voxel-net")
    new_model(store, f"voxel-net/{version}")
    if threads is not None:
        torch.set_num_threads(threads)
    buildings = {"office": offices, "corridor": corridors, "room": rooms}
    settings = VoxelSampleSettings.model_validate({"buildings": buildings})
    seeing, blind = (VoxelTrainSettings(epochs=count) for count in (epochs, blind_epochs))
    with terminal.progress_bar() as progress:
        make_samples(settings, folder / "samples", progress)
        samples = load_samples(folder / "samples")
        checkpoints = train_networks(samples, seeing, blind, folder, progress)
    model = publish(
        checkpoints,
        samples,
        store,
        version=version,
        summary=SUMMARY,
        command=f"spicd-worker train-voxels FOLDER --offices {offices} --corridors {corridors} --rooms {rooms} "
        f"--epochs {epochs} --blind-epochs {blind_epochs}",
        about={"simulated": settings.model_dump(mode="json")},
    )
    terminal.output().print(
        f"{model}\nopen it as --model voxel-net/{version} --store {store}", highlight=False
    )
