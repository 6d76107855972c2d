"""`spicd surveys` and `spicd changes`: later visits, and what they found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table

from service.cli.tables import columns, counts, facts, number, placement, point, scan_table
from service.cli.terminal import Captured, Device, Model, Scans, Terminal, Wait
from service.client import Document


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
        survey_id = accepted["survey_id"]
        terminal.accepted(
            client,
            f"survey {survey_id}",
            accepted,
            wait,
            lambda: client.survey(survey_id),
            _whole(terminal.url),
        )


def list_(ctx: typer.Context, map_id: str) -> None:
    """Every survey of a map."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.surveys(map_id), _table)


def show(ctx: typer.Context, survey_id: str) -> None:
    """One survey with its placement, its scans and counts."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.survey(survey_id), _whole(terminal.url))


def changes(
    ctx: typer.Context,
    map_id: str,
    survey: Annotated[str | None, typer.Option(help="Of this survey only.")] = None,
    bbox: Annotated[str | None, typer.Option(help="4 or 6 numbers with commas, map frame, metres.")] = None,
    datetime: Annotated[str | None, typer.Option(help="Instant or interval, `..` for open.")] = None,
    min_score: Annotated[float | None, typer.Option("--min-score", help="Probability of change.")] = None,
    repeats: Annotated[bool, typer.Option("--repeats", help="Once for each visit that saw it.")] = False,
    limit: Annotated[int, typer.Option(help="At most so many.")] = 100,
) -> None:
    """The changed tiles of a map, each change once, newest first."""
    terminal: Terminal = ctx.obj
    filters = {"survey": survey, "bbox": bbox, "datetime": datetime, "min_score": min_score, "limit": limit}
    if repeats:
        filters["repeats"] = True
    terminal.ask(lambda client: client.changes(map_id, **filters), _change_table)


def _table(surveys: Sequence[Document]) -> Table:
    table = columns("survey", "status", "captured", "scans", "placement", "counts")
    for one in surveys:
        scans = str(len(one.get("scans", [])))
        table.add_row(
            one["survey_id"], one["status"], one.get("captured_at"), scans, placement(one), counts(one)
        )
    return table


def _whole(url: str) -> Callable[[Document], Group]:
    """Return what draws a survey of the service at `url`."""

    def draw(survey: Document) -> Group:
        about = {
            "survey": survey["survey_id"],
            "map": survey.get("map_id"),
            "captured": survey.get("captured_at"),
        }
        here = f"{url}/surveys/{survey['survey_id']}"
        rows = {
            "placement": placement(survey),
            "tiles": counts(survey),
            "objects": counts(survey, "objects"),
            "moving": survey.get("moving"),
        }
        if survey["status"] == "ready":
            rows |= {
                "cloud": f"{here}/cloud.ply",
                "picture": f"{here}/picture.png",
                "features": f"{here}/tiles",
            }
            if survey.get("objects") is not None:
                rows["things"] = f"{here}/objects"
        elif (survey.get("placement") or {}).get("state") == "refused":
            rows["picture"] = f"{here}/picture.png"
        names = ("survey", "map", "status", "captured", "model", "threshold")
        return Group(facts({**survey, **about}, *names, **rows), scan_table(survey))

    return draw


def _change_table(collection: Document) -> Group:
    table = columns("tile", "state", "score", "center (m)", "survey", "first seen", "last seen")
    features = collection["features"]
    for tile in (feature["properties"] for feature in features):
        table.add_row(
            tile["tile_id"],
            tile["state"],
            number(tile.get("score"), 2),
            point(tile["center"]),
            tile["survey_id"],
            tile.get("first_seen"),
            tile.get("last_seen"),
        )
    total = collection.get("numberMatched", len(features))
    return Group(table, f"{len(features)} of {total} changed tiles")
