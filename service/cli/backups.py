"""`spicd backup` and `spicd restore`: on the data folder, the database and the blobs themselves, not through the API."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from service.cli.terminal import Terminal
from service.client import ClientError
from service.permissions import make_private, private_files
from service.settings import Settings

if TYPE_CHECKING:
    from service.catalog.files.backup import Backup

DataDir = Annotated[Path | None, typer.Option("--data-dir", help="Of the service; else SPICD_DATA_DIR.")]


def backup(
    ctx: typer.Context,
    folder: Annotated[Path, typer.Argument(help="A new folder for the copy.")],
    data_dir: DataDir = None,
) -> None:
    """Copy everything that is kept, while the service runs or not; SPICD_* name the database and the blobs."""
    _run("backup", ctx, folder, data_dir)


def restore(
    ctx: typer.Context,
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="A copy that `backup` made.")],
    data_dir: DataDir = None,
) -> None:
    """Fill an empty data folder, or database and blob store, from a copy; start the service afterwards."""
    _run("restore", ctx, folder, data_dir)


def _run(what: str, ctx: typer.Context, folder: Path, data_dir: Path | None) -> None:
    # SQLAlchemy and obstore take a while to import, and no other command needs them.
    from service.catalog.files import backup as backups  # noqa: PLC0415
    from service.errors import ServiceError  # noqa: PLC0415

    terminal: Terminal = ctx.obj
    settings = Settings() if data_dir is None else Settings(data_dir=data_dir)
    try:
        with private_files():
            if what == "backup":
                done, keys = backups.backup(settings, folder), None
            else:
                restored = backups.restore(settings, folder)
                done, keys = restored.copy, restored.keys
                if None in (settings.database_url, settings.blob_url):
                    make_private(settings.data_dir)
    except (backups.BackupFailed, ServiceError) as error:
        raise ClientError(str(error)) from error
    terminal.show(_document(done) | ({} if keys is None else {"keys": keys}), _table)
    if keys:
        terminal.err.print(
            f"API keys of the copy that are valid again: {keys}; `spicd keys list` shows them, and `spicd keys revoke` ends those "
            "that were revoked since it was taken"
        )
    if done.missing:
        terminal.err.print(
            f"{len(done.missing)} files that the database names are not in the blob store: {', '.join(done.missing[:5])}"
        )


def _document(done: Backup) -> dict[str, Any]:
    return {
        "created": done.created,
        "revision": done.revision,
        "rows": done.rows,
        "blobs": done.blobs,
        "missing": list(done.missing),
    }


def _table(document: dict[str, Any]) -> Table:
    table = Table(title=f"backup of {document['created']}", show_header=False)
    for name in ("scans", "maps", "surveys", "models", "jobs"):
        table.add_row(name, f"{document['rows'].get(name, 0):,}")
    table.add_row("files", f"{document['blobs']:,}")
    return table
