"""`spicd objects`: the things that visits found changed, over time or of one visit."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.console import Group

from service.cli.completion import MapId
from service.cli.tables import columns, facts, number, point
from service.cli.terminal import Terminal
from service.client import Client, ClientError, Document


def objects(
    ctx: typer.Context,
    map_id: MapId,
    object_id: Annotated[str | None, typer.Argument(help="Only this one, with each sighting of it.")] = None,
    survey: Annotated[str | None, typer.Option(help="As this survey saw them.")] = None,
    kind: Annotated[str | None, typer.Option(help="appeared, disappeared or moved.")] = None,
    status: Annotated[
        str | None, typer.Option(help="new, still_there, gone_again, unknown or accepted.")
    ] = None,
    last_known: Annotated[
        str | None, typer.Option("--last-known", help="Likewise, when somebody last looked there.")
    ] = None,
    transient: Annotated[
        bool | None, typer.Option("--transient/--standing", help="What comes and goes, or what does not.")
    ] = None,
    bbox: Annotated[str | None, typer.Option(help="4 or 6 numbers with commas, map frame, metres.")] = None,
    datetime: Annotated[str | None, typer.Option(help="Instant or interval, `..` for open.")] = None,
    min_probability: Annotated[float | None, typer.Option("--min-probability", help="Of change.")] = None,
    limit: Annotated[int, typer.Option(help="At most so many.")] = 100,
) -> None:
    """The changed objects of a map, each once, newest first."""
    terminal: Terminal = ctx.obj
    common = {"kind": kind, "min_probability": min_probability}
    over_time = {
        "status": status,
        "last_known": last_known,
        "transient": transient,
        "bbox": bbox,
        "datetime": datetime,
    }
    if object_id is not None:
        _refuse(f"object {object_id} is one already", survey=survey, **common, **over_time)
        terminal.ask(lambda client: client.object(map_id, object_id), _history)
    elif survey is not None:
        _refuse("of one survey there is --kind and --min-probability", **over_time)
        terminal.ask(lambda client: _of_survey(client, map_id, survey, **common, limit=limit), _seen_table)
    else:
        # else the Earth's frame, of a map that has an anchor
        frame = {"bbox-crs": None if bbox is None else "map"}
        filters = {**common, **over_time, **frame}
        terminal.ask(lambda client: client.objects(map_id, **filters, limit=limit), _object_table)


def _refuse(why: str, **filters: Any) -> None:
    """Raise ClientError where a filter was given that has no meaning here."""
    given = [f"--{name.replace('_', '-')}" for name, value in filters.items() if value is not None]
    if given:
        raise ClientError(f"{why}; leave {', '.join(given)} out")


def _of_survey(client: Client, map_id: str, survey: str, **filters: Any) -> Document:
    """Return the objects of a survey. Raises ClientError for one of another map."""
    theirs = client.survey(survey).get("map_id")
    if theirs != map_id:
        raise ClientError(f"survey {survey} is of map {theirs}, not of {map_id}")
    return client.survey_objects(survey, **filters)


def _object_table(collection: Document) -> Group:
    table = columns(
        "object", "kind", "status", "place (m)", "size (m)", "probability", "first seen", "last seen"
    )
    for thing in _properties(collection):
        status = thing["status"].replace("_", " ") + (", transient" if thing["transient"] else "")
        table.add_row(
            thing["object_id"],
            thing["kind"],
            status,
            *_place(thing),
            number(thing["probability"], 2),
            thing["first_seen"],
            thing["last_seen"],
        )
    return Group(table, _total(collection))


def _seen_table(collection: Document) -> Group:
    table = columns("number", "kind", "place (m)", "size (m)", "probability", "object", "first seen")
    for thing in _properties(collection):
        table.add_row(
            str(thing["number"]),
            thing["kind"],
            *_place(thing),
            number(thing["probability"], 2),
            thing["object_id"],
            thing["first_seen"],
        )
    return Group(table, _total(collection))


def _history(feature: Document) -> Group:
    thing = feature["properties"]
    names = ("status", "transient", "first_seen", "last_seen", "last_looked", "accepted_in_version")
    rows = {name.replace("_", " "): thing[name] for name in names}
    table = columns("captured", "survey", "number", "kind", "place (m)", "size (m)", "probability")
    for seen in _properties({"features": feature["sightings"]}):
        table.add_row(
            seen["captured_at"],
            seen["survey_id"],
            str(seen["number"]),
            seen["kind"],
            *_place(seen),
            number(seen["probability"], 2),
        )
    return Group(facts({"object": thing["object_id"]}, "object", **rows), table)


def _properties(collection: Document) -> list[Document]:
    return [feature["properties"] for feature in collection["features"]]


def _place(thing: Document) -> tuple[str, str]:
    """Write where a thing is, or was, and how large it is."""
    now, before = thing["now"], thing["before"]
    shown = now or before
    where = point(shown["center"])
    if now and before:
        where = f"{point(before['center'])} to {where}"
    return where, " x ".join(number(side, 2) for side in shown["size"])


def _total(collection: Document) -> str:
    shown = len(collection["features"])
    return f"{shown} of {collection.get('numberMatched', shown)} objects"
