"""`spicd-worker`: its commands, and how it says that something went wrong."""

from __future__ import annotations

import sys

import typer

from worker.cli import cards, evaluate, terminal
from worker.cli.demo import demo
from worker.cli.detect import detect
from worker.cli.publish import publish
from worker.cli.register import register
from worker.cli.train import train, with_training_options
from worker.cli.train_voxels import train_voxels
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
    for command in (
        detect,
        register,
        with_training_options(train),
        publish,
        train_voxels,
        demo,
        evaluate.bench,
        evaluate.bench_network,
    ):
        commands.command()(command)
    measuring = typer.Typer(no_args_is_help=True, help="How good it is, measured where the truth is known.")
    for command in (
        evaluate.registration,
        evaluate.placement,
        evaluate.paper,
        evaluate.revisit,
        evaluate.real,
        evaluate.precision,
        cards.speed,
        cards.record,
        cards.table,
    ):
        measuring.command()(command)
    commands.add_typer(measuring, name="evaluate")
    return commands
