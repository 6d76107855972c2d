"""`spicd`: its commands, its global options, and how it says that something went wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Annotated

import typer

from service.cli import (
    backups,
    events,
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
    webhooks,
)
from service.cli.terminal import Terminal, in_commands
from service.client import DEFAULT_URL, ClientError
from service.up.embedded_redis import LaunchFailed

#: Each command with an example of its use.
ALONE: dict[Callable[..., None], str] = {
    up.up: "up --port 8000 --data-dir data",
    surveys.changes: "changes lobby --min-score 0.8 --csv > changes.csv",
    objects.objects: "objects lobby --status new",
    jobs.jobs: "jobs job-5f0c --wait",
    sweep.sweep: "sweep --dry-run",
    backups.backup: "backup /mnt/backup/monday",
    backups.restore: "restore /mnt/backup/monday",
}
GROUPS: dict[str, tuple[str, dict[Callable[..., None], str]]] = {
    "scans": (
        "Scans: upload them, list them.",
        {
            scans.add: "add monday.pcd --device-id robot-7",
            scans.list_: "list",
            scans.show: "show scan-19df",
            scans.delete: "delete scan-19df",
            watch.watch: "watch /data/visits --map lobby",
            from_bag.from_bag: "from-bag patrol.mcap --to /data/scans",
        },
    ),
    "maps": (
        "Reference maps.",
        {
            maps.create: "create monday.pcd --id lobby --wait",
            maps.list_: "list",
            maps.show: "show lobby",
            maps.anchor: "anchor lobby --longitude 13.3777 --latitude 52.5163 --height 76 --heading 12.5",
            maps.delete: "delete lobby",
        },
    ),
    "versions": (
        "Versions of a map.",
        {
            versions.add: "add lobby --survey survey-91c4 --wait",
            versions.list_: "list lobby",
            versions.show: "show lobby 2",
            versions.delete: "delete lobby 1",
        },
    ),
    "surveys": (
        "Later visits of a mapped space.",
        {
            surveys.submit: "submit lobby tuesday.pcd --wait",
            surveys.list_: "list lobby",
            surveys.show: "show survey-91c4",
            surveys.download: "download survey-91c4 --to tuesday",
            surveys.delete: "delete survey-91c4",
        },
    ),
    "events": (
        "What happens, as it happens.",
        {events.follow: "follow --type survey.ready --map lobby"},
    ),
    "webhooks": (
        "Addresses that events are sent to.",
        {
            webhooks.add: "add https://dashboard.example.org/spicd --type survey.ready",
            webhooks.list_: "list",
            webhooks.ping: "ping webhook-7a01",
            webhooks.deliveries: "deliveries webhook-7a01",
            webhooks.repeat: "repeat webhook-7a01 delivery-88a0",
            webhooks.rotate: "rotate webhook-7a01",
            webhooks.remove: "remove webhook-7a01",
        },
    ),
    "keys": (
        "API keys: who may ask the service.",
        {
            keys.add: "add 'robot 7' --scope scans:write --scope surveys:write --map lobby --days 365",
            keys.list_: "list",
            keys.revoke: "revoke key-5d20",
        },
    ),
    "models": (
        "Models that score tiles; alone, it lists them.",
        {models.train: "train lobby --minutes 10 --wait"},
    ),
}
#: Options that stand before the command or behind it, and are not in its list. `\n\n` begins a paragraph.
_EVERYWHERE = "\n\nWith every command: --url ADDRESS (or SPICD_URL; the key in SPICD_KEY), --json."
_GLOBAL_FLAGS = ("--json",)
_GLOBAL_OPTIONS = ("--url",)


def main(arguments: list[str] | None = None) -> None:
    """Run one command; ends the process with status 0, 1 where it failed, 2 where it was called wrongly."""
    words = _hoisted(sys.argv[1:] if arguments is None else arguments)
    try:
        _commands()(args=words, prog_name="spicd")
    except (ClientError, LaunchFailed) as error:
        Terminal(url="", as_json=False).fail(in_commands(str(error)))
        raise SystemExit(1) from None


def _commands() -> typer.Typer:
    commands = typer.Typer(
        name="spicd",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        help="Says what changed in a building: LiDAR scans in, changed objects and tiles out.",
        epilog="Example: spicd --install-completion, then spicd maps show and the tabulator key",
    )
    commands.callback()(_options)
    for function, example in ALONE.items():
        _add(commands, function, example)
    for name, (help_text, functions) in GROUPS.items():
        group = typer.Typer(no_args_is_help=name != "models", help=help_text)
        for function, example in functions.items():
            _add(group, function, f"{name} {example}")
        commands.add_typer(group, name=name)
        if name == "models":
            group.callback(invoke_without_command=True)(models.list_)
    return commands


def _add(group: typer.Typer, function: Callable[..., None], example: str) -> None:
    """Add a command under the name of its function, with an example below its help."""
    group.command(
        function.__name__.rstrip("_").replace("_", "-"), epilog=f"Example: spicd {example}{_EVERYWHERE}"
    )(function)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"spicd {version('spicd')}")
        raise typer.Exit


def _options(
    ctx: typer.Context,
    url: Annotated[str, typer.Option(envvar="SPICD_URL", help="Address of the service.")] = DEFAULT_URL,
    as_json: Annotated[
        bool, typer.Option("--json", help="Results as JSON on stdout, nothing else there.")
    ] = False,
    _: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="What is installed, and nothing else."
        ),
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
