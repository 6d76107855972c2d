"""`spicd surveys` and `spicd changes`: later visits, and what they found."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table

from service.cli.maps import Model, Scans, Wait, accepted_line, counts, facts, number, scan_table
from service.cli.scans import Captured, Device
from service.cli.terminal import Terminal, columns
from service.client import Document


def register(commands: typer.Typer) -> None:
    """Add `surveys` and `changes` to the command line."""
    group = typer.Typer(no_args_is_help=True, help="Later visits of a mapped space.")
    group.command("submit")(submit)
    group.command("list")(list_)
    group.command("show")(show)
    commands.add_typer(group, name="surveys")
    commands.command("changes")(changes)


def submit(
    ctx: typer.Context,
    map_id: str,
    scans: Scans,
    model: Model = None,
    threshold: Annotated[float | None, typer.Option(help="Probability of change, 0 to 1.")] = None,
    device_id: Device = None,
    captured_at: Captured = None,
    wait: Wait = False,
) -> None:
    """Compare scans with a map."""
    terminal: Terminal = ctx.obj
    about = {"device_id": device_id, "captured_at": captured_at}
    with terminal.client() as client:
        ids = terminal.scan_ids(client, scans, **about)
        accepted = client.submit_survey(map_id, ids, model=model, threshold=threshold, **about)
        if not wait:
            terminal.show(accepted, lambda: accepted_line("survey", accepted))
            return
        terminal.wait(client, accepted["job_id"])
        found = client.survey(accepted["survey_id"])
    terminal.show(found, lambda: _whole(found, terminal.url))


def list_(ctx: typer.Context, map_id: str) -> None:
    """Every survey of a map."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.surveys(map_id)
    terminal.show(found, lambda: _table(found))


def show(ctx: typer.Context, survey_id: str) -> None:
    """One survey with its scans and counts."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.survey(survey_id)
    terminal.show(found, lambda: _whole(found, terminal.url))


def changes(
    ctx: typer.Context,
    map_id: str,
    survey: Annotated[str | None, typer.Option(help="Of this survey only.")] = None,
    bbox: Annotated[str | None, typer.Option(help="4 or 6 numbers with commas, map frame, metres.")] = None,
    datetime: Annotated[str | None, typer.Option(help="Instant or interval, `..` for open.")] = None,
    min_score: Annotated[float | None, typer.Option("--min-score", help="Probability of change.")] = None,
    limit: Annotated[int, typer.Option(help="At most so many.")] = 100,
) -> None:
    """The changed tiles of a map, newest first."""
    terminal: Terminal = ctx.obj
    with terminal.client() as client:
        found = client.changes(
            map_id, survey=survey, bbox=bbox, datetime=datetime, min_score=min_score, limit=limit
        )
    terminal.show(found, lambda: _change_table(found))


def _table(surveys: list[Document]) -> Table:
    table = columns("survey", "status", "captured", "scans", "counts")
    for one in surveys:
        scans = str(len(one.get("scans", [])))
        table.add_row(one["survey_id"], one["status"], one.get("captured_at"), scans, counts(one))
    return table


def _whole(found: Document, url: str) -> Group:
    survey_id = found["survey_id"]
    ready = found["status"] == "ready"
    about = facts(
        [
            ("survey", survey_id),
            ("map", found.get("map_id")),
            ("status", found["status"]),
            ("captured", found.get("captured_at")),
            ("model", found.get("model")),
            ("threshold", found.get("threshold")),
            ("tiles", counts(found)),
            ("cloud", f"{url}/surveys/{survey_id}/cloud.ply" if ready else None),
            ("picture", f"{url}/surveys/{survey_id}/picture.png" if ready else None),
            ("features", f"{url}/surveys/{survey_id}/tiles" if ready else None),
        ]
    )
    return Group(about, scan_table(found.get("scans", [])))


def _change_table(found: Document) -> Group:
    table = columns("tile", "state", "score", "center (m)", "survey", "captured")
    for feature in found["features"]:
        tile = feature["properties"]
        center = ", ".join(f"{value:.2f}" for value in tile["center"])
        score = number(tile.get("score"), 2)
        table.add_row(
            tile["tile_id"], tile["state"], score, center, tile["survey_id"], tile.get("captured_at")
        )
    total = found.get("numberMatched", len(found["features"]))
    return Group(table, f"{len(found['features'])} of {total} changed tiles")
