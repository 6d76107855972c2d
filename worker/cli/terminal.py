"""Where a command's words go: results to stdout, progress and errors to stderr."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from worker.progress import Progress as OnProgress

Result = dict[str, Any]  #: JSON-ready
PIPE_WIDTH = 160  #: characters; where nobody says how wide the place is that stdout goes to


def output() -> Console:
    """Return the console for results."""
    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH)


def messages() -> Console:
    """Return the console for everything else."""
    return Console(stderr=True)


def is_attended() -> bool:
    """Tell whether a person sits before it, who can press Ctrl-C: a terminal both ways, and no continuous integration."""
    return sys.stdin.isatty() and sys.stdout.isatty() and not os.environ.get("CI")


def show(
    result: Result, tables: Callable[[Result], RenderableType], *notes: str, as_json: bool = False
) -> None:
    """Print a result on stdout: as JSON and nothing else, or its tables with the notes below them.

    Names of files are printed as they are, brackets and all.
    """
    if as_json:
        sys.stdout.write(json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    else:
        output().print(Group(tables(result), *notes), highlight=False, markup=False)


def fail(sentence: str) -> None:
    """Say in one line what went wrong."""
    messages().print(sentence, style="bold red", highlight=False, markup=False, soft_wrap=True)


@contextmanager
def progress_bar() -> Iterator[OnProgress]:
    """Show a bar that is gone when the work is done; it starts anew with each stage."""
    console = messages()
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("starting", total=1.0)

        def show(stage: str, share: float) -> None:
            bar.update(task, description=stage, completed=share)

        yield show
