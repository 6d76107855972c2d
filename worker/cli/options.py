"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

Model = Annotated[str, typer.Option(envvar="SPICD_MODEL", help="name/version")]
ModelStore = Annotated[
    Path, typer.Option("--model-store", envvar="SPICD_MODEL_STORE", help="Folder of the models.")
]
Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(envvar="SPICD_DEVICE")]
AsJson = Annotated[bool, typer.Option("--json", help="Results as JSON on stdout, nothing else there.")]
DEFAULT_MODEL = "voxel-net/1"
PAPER_MODEL = "spicd-net/2"  #: the method of the paper, which its experiments are made for
