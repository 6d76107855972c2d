"""`spicd sweep`: remove what is older than it has to be kept, as the API does by itself once an hour."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from service.cli.settings import read_settings
from service.cli.terminal import Terminal
from service.settings import Settings
from service.up.embedded_redis import LaunchFailed

if TYPE_CHECKING:
    from service.catalog.files import retention


def sweep(
    ctx: typer.Context,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List what would go, and change nothing.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Also where more files than kills leave have no row.")
    ] = False,
    data_dir: Annotated[Path | None, typer.Option("--data-dir", help="Of the service.")] = None,
) -> None:
    """Remove surveys and scans past SPICD_KEEP_..._DAYS, and files whose row is gone. Works on the database itself."""
    from service.catalog.catalog import open_catalog  # noqa: PLC0415
    from service.catalog.files import retention  # noqa: PLC0415 - the other commands start the faster without
    from service.catalog.sql.tables import now  # noqa: PLC0415

    terminal: Terminal = ctx.obj
    settings = read_settings(data_dir=data_dir)
    _require_database(settings)
    catalog = open_catalog(settings, migrate=False)
    try:
        policy = retention.policy_of(settings, now())
        found = retention.find(catalog, policy)
        if found.doubtful and not (force or dry_run):
            raise LaunchFailed(
                f"{len(found.folders)} folders of files have no row in the database and {found.folders_known} have one; "
                "is it the right database? `--dry-run` lists them, `--force` removes them"
            )
        swept = None if dry_run else retention.remove(catalog, policy, found)
    finally:
        catalog.close()
    document = {"surveys": found.surveys, "scans": found.scans, "folders": found.folders, "removed": swept}
    terminal.show(document, lambda _: _table(found, dry_run=dry_run))


def _require_database(settings: Settings) -> None:
    """Raise LaunchFailed where the embedded database is meant and not there: opening it would make one."""
    path = settings.data_dir / "spicd.sqlite"
    if settings.database_url is None and not path.is_file():
        raise LaunchFailed(f"no database {path}; name the data folder with --data-dir, or SPICD_DATABASE_URL")


def _table(found: retention.Leftovers, *, dry_run: bool) -> Table | str:
    if not (found.surveys or found.scans or found.folders):
        return "nothing to sweep"
    table = Table("what", "which", title="would go" if dry_run else "is gone")
    for what in ("surveys", "scans", "folders"):
        for name in getattr(found, what):
            table.add_row({"folders": "files without a row"}.get(what, what[:-1]), name)
    return table
