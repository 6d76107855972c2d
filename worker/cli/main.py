"""`spicd-worker`: its commands, and how it says that something went wrong."""

from __future__ import annotations

import sys

import typer

from worker.cli import bench, demo, detect, evaluate, register, terminal, train
from worker.demo.service import DemoFailed
from worker.errors import PipelineError
from worker.threads import wait_passively


def main(arguments: list[str] | None = None) -> None:
    """Run one command; ends the process with status 0, 1 where it failed, 2 where it was called wrongly."""
    wait_passively()
    try:
        _commands()(args=sys.argv[1:] if arguments is None else arguments, prog_name="spicd-worker")
    except (PipelineError, DemoFailed, ValueError, ArithmeticError) as error:
        terminal.fail(str(error))
        raise SystemExit(1) from None
    except OSError as error:
        terminal.fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        raise SystemExit(1) from None


def _commands() -> typer.Typer:
    commands = typer.Typer(
        name="spicd-worker",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        help="Compares LiDAR scans of a space on this machine, trains the detector, and shows the whole service.",
    )
    for part in (detect, register, train, demo, bench, evaluate):
        part.register(commands)
    return commands
