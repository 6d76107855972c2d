"""`spicd keys`: who may ask the service. Works on the database itself, where the service keeps its own."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Group
from rich.table import Table

from service.cli.settings import read_settings
from service.cli.tables import columns, facts
from service.cli.terminal import Terminal
from service.client import ClientError, Document
from service.errors import ServiceError
from service.permissions import private_files

if TYPE_CHECKING:
    from service.catalog.keys import Keys
    from service.catalog.records import KeyRecord

DataDir = Annotated[Path | None, typer.Option("--data-dir", help="That of the service, as for `spicd up`.")]
_LONGEST_FILE = 1024  #: bytes; a secret has about fifty


def add(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(help="Whose it is, for people.")],
    scope: Annotated[
        list[str],
        typer.Option(help="scans:write, surveys:write, maps:write, changes:read or admin; repeat it."),
    ],
    map_id: Annotated[list[str] | None, typer.Option("--map", help="Bind it to this map; repeat it.")] = None,
    days: Annotated[float | None, typer.Option(min=0, help="Until it expires; left out: never.")] = None,
    secret_file: Annotated[
        Path | None,
        typer.Option(
            help="Take the secret from a file, as one is mounted into a container; twice changes nothing."
        ),
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Make a key. Its secret is shown now and never again; send it as SPICD_KEY or `Authorization: Bearer`."""
    terminal: Terminal = ctx.obj
    secret = None if secret_file is None else _read_secret(secret_file)
    expires = None if days is None else datetime.now(UTC) + timedelta(days=days)
    with _keys(data_dir) as keys:
        record, secret = keys.add(name, scopes=scope, maps=map_id or None, expires=expires, secret=secret)
    document = {**_document(record), **({"secret": secret} if secret_file is None else {})}
    if secret_file is None:
        terminal.note("keep the secret now: only its digest is stored")
    terminal.show(document, _whole)


def list_(ctx: typer.Context, data_dir: DataDir = None) -> None:
    """Every key, without its secret."""
    terminal: Terminal = ctx.obj
    with _keys(data_dir) as keys:
        records = keys.all()
    terminal.show([_document(record) for record in records], _table)


def revoke(ctx: typer.Context, key_id: str, data_dir: DataDir = None) -> None:
    """Have a key taken no more; requests that bring it are refused from now on."""
    terminal: Terminal = ctx.obj
    with _keys(data_dir) as keys:
        record = keys.revoke(key_id)
    terminal.show(_document(record), lambda _: f"key {key_id} ({record.name}) is revoked")


@contextlib.contextmanager
def _keys(data_dir: Path | None) -> Iterator[Keys]:
    """Open the keys that the settings name, with tables that are up to date. Raises ClientError in one sentence."""
    # the database is of no use to the other commands, which start the faster without
    from service.catalog.keys import open_keys  # noqa: PLC0415

    settings = read_settings(data_dir=data_dir)
    with contextlib.ExitStack() as stack:
        stack.enter_context(private_files())
        try:
            keys = stack.enter_context(open_keys(settings))
        except Exception as error:  # whatever the driver raises
            raise ClientError(f"the database cannot be opened: {' '.join(str(error).split())}") from error
        try:
            yield keys
        except ServiceError as error:
            raise ClientError(str(error)) from error


def _read_secret(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(_LONGEST_FILE).decode("ascii", "replace").strip()
    except OSError as error:
        raise ClientError(f"{path}: the secret cannot be read ({error.strerror})") from error


def _document(record: KeyRecord) -> Document:
    return record.model_dump(mode="json")


def _state(key: Document) -> str:
    if key["revoked"] is not None:
        return "revoked"
    expires = key["expires"]
    return (
        "expired" if expires is not None and datetime.fromisoformat(expires) <= datetime.now(UTC) else "valid"
    )


def _shown(key: Document) -> dict[str, Any]:
    maps = "all" if key["maps"] is None else ", ".join(key["maps"])
    return {
        **key,
        "key": key["key_id"],
        "scopes": ", ".join(key["scopes"]),
        "maps": maps,
        "state": _state(key),
    }


def _table(keys: list[Document]) -> Table:
    names = ("key", "name", "scopes", "maps", "state", "created", "expires")
    table = columns(*names)
    for key in map(_shown, keys):
        table.add_row(*(str(key[name] or "") for name in names))
    return table


def _whole(key: Document) -> Group:
    return Group(facts(_shown(key), "key", "name", "scopes", "maps", "expires", "secret"))
