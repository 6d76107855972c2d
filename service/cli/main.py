"""`spicd`: its commands, its global options, and how it says that something went wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated

import typer

from service.cli import (
    backups,
    from_bag,
    jobs,
    keys,
    maps,
    models,
    objects,
    scans,
    surveys,
    sweep,
    up,
    versions,
    watch,
)
from service.cli.terminal import Terminal
from service.client import DEFAULT_URL, ClientError
from service.up.embedded_redis import LaunchFailed

_GLOBAL_FLAGS = ("--json",)
_GLOBAL_OPTIONS = ("--url",)


def main(arguments: list[str] | None = None) -> None:
    """Run one command; ends the process with status 0, 1 where it failed, 2 where it was called wrongly."""
    words = _hoisted(sys.argv[1:] if arguments is None else arguments)
    try:
        _commands()(args=words, prog_name="spicd")
    except (ClientError, LaunchFailed) as error:
        Terminal(url="", as_json=False).fail(str(error))
        raise SystemExit(1) from None


def _commands() -> typer.Typer:
    commands = typer.Typer(
        name="spicd",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        help="Says what changed in a building: LiDAR scans in, changed objects and tiles out.",
    )
    commands.callback()(_options)
    commands.command()(up.up)
    commands.command()(sweep.sweep)
    commands.command()(backups.backup)
    commands.command()(backups.restore)
    _add_group(commands, "scans", "Upload scans.", scans.add, watch.watch, from_bag.from_bag)
    _add_group(commands, "maps", "Reference maps.", maps.create, maps.list_, maps.show, maps.delete)
    of_versions = (versions.add, versions.list_, versions.show, versions.delete)
    _add_group(commands, "versions", "Versions of a map.", *of_versions)
    of_surveys = (surveys.submit, surveys.list_, surveys.show)
    _add_group(commands, "surveys", "Later visits of a mapped space.", *of_surveys)
    commands.command()(surveys.changes)
    commands.command()(objects.objects)
    commands.command()(jobs.jobs)
    _add_group(commands, "keys", "API keys: who may ask the service.", keys.add, keys.list_, keys.revoke)
    of_models = _add_group(commands, "models", "Models that score tiles; alone, it lists them.", models.train)
    of_models.info.no_args_is_help = False
    of_models.callback(invoke_without_command=True)(models.list_)
    return commands


def _add_group(commands: typer.Typer, name: str, help_text: str, *group: Callable[..., None]) -> typer.Typer:
    """Add a group of commands to the command line, each under the name of its function."""
    added = typer.Typer(no_args_is_help=True, help=help_text)
    for command in group:
        added.command(command.__name__.rstrip("_").replace("_", "-"))(command)
    commands.add_typer(added, name=name)
    return added


def _options(
    ctx: typer.Context,
    url: Annotated[str, typer.Option(envvar="SPICD_URL", help="Address of the service.")] = DEFAULT_URL,
    as_json: Annotated[
        bool, typer.Option("--json", help="Results as JSON on stdout, nothing else there.")
    ] = False,
) -> None:
    ctx.obj = Terminal(url=url, as_json=as_json)


def _hoisted(words: list[str]) -> list[str]:
    """Return the same words with the global options first, so that `spicd maps list --json` works as well."""
    first: list[str] = []
    rest: list[str] = []
    waiting = iter(words)
    for word in waiting:
        if word == "--":
            rest += [word, *waiting]
        elif word in _GLOBAL_FLAGS or word.startswith(tuple(f"{name}=" for name in _GLOBAL_OPTIONS)):
            first.append(word)
        elif word in _GLOBAL_OPTIONS:
            first += [word, *([value] if (value := next(waiting, None)) is not None else [])]
        else:
            rest.append(word)
    return first + rest
