"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Model = Annotated[str, typer.Option(envvar="SPICD_MODEL", help="name/version")]
ModelStore = Annotated[
    Path, typer.Option("--model-store", envvar="SPICD_MODEL_STORE", help="Folder of the models.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Figures as JSON on stdout.")]
DEFAULT_MODEL = "spicd-net/1"
