"""Where a command's words go: results to stdout, progress and errors to stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from worker.progress import Progress as OnProgress

PIPE_WIDTH = 160  #: characters; where nobody says how wide the place is that stdout goes to


def output() -> Console:
    """For results."""
    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH)


def messages() -> Console:
    """For everything else."""
    return Console(stderr=True)


def print_json(document: Any) -> None:
    """JSON on stdout, nothing else there."""
    sys.stdout.write(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def fail(sentence: str) -> None:
    """Say in one line what went wrong."""
    messages().print(sentence, style="bold red", highlight=False, markup=False, soft_wrap=True)


@contextmanager
def progress_bar() -> Iterator[OnProgress]:
    """A bar that is gone when the work is done; it starts anew with each stage."""
    console = messages()
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("starting", total=1.0)

        def show(stage: str, share: float) -> None:
            bar.update(task, description=stage, completed=share)

        yield show
