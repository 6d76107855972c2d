"""`spicd surveys` and `spicd changes`: later visits, and what they found."""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.table import Table

from service.cli.completion import MapId, SurveyId
from service.cli.tables import columns, counts, facts, failure, number, placement, point, scan_table, warnings
from service.cli.terminal import Captured, Device, Model, Scans, Terminal, Wait
from service.client import Client, ClientError, Document, RequestRefused
from service.client.documents import SurveyDocument

NAMED_SCANS = 200  #: of a survey, whose files are asked for one by one
CSV_PAGE = OBJECTS_PAGE = 1000  #: in one answer


def submit(
    ctx: typer.Context,
    map_id: MapId,
    scans: Scans,
    model: Model = None,
    threshold: Annotated[float | None, typer.Option(help="Probability of change, 0 to 1.")] = None,
    device_id: Device = None,
    captured_at: Captured = None,
    wait: Wait = False,
) -> None:
    """Compare scans with a map."""
    terminal: Terminal = ctx.obj
    about: dict[str, Any] = {"device_id": device_id, "captured_at": captured_at}
    with terminal.client() as client:
        ids = terminal.scan_ids(client, scans, **about)
        accepted = client.submit_survey(map_id, ids, model=model, threshold=threshold, **about)
        survey_id = accepted["survey_id"]
        terminal.accepted(
            client,
            f"survey {survey_id}",
            accepted,
            wait,
            lambda: _asked(client, survey_id, as_json=terminal.as_json),
            _whole(terminal.url),
        )


def list_(ctx: typer.Context, map_id: MapId) -> None:
    """Every survey of a map."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: client.surveys(map_id), _table)


def show(ctx: typer.Context, survey_id: SurveyId) -> None:
    """One survey with its placement, its scans and their files, and counts."""
    terminal: Terminal = ctx.obj
    terminal.ask(lambda client: _asked(client, survey_id, as_json=terminal.as_json), _whole(terminal.url))


def _asked(client: Client, survey_id: str, *, as_json: bool) -> Document:
    """Return a survey, for people with the name of each scan's file; --json shows the document as it is."""
    survey = client.survey(survey_id)
    if as_json or len(survey["scans"]) > NAMED_SCANS:
        return survey
    return {**survey, "scans": [{**scan, "file": _file(client, scan["scan_id"])} for scan in survey["scans"]]}


def _file(client: Client, scan_id: str) -> str | None:
    """Return the name of a scan's file; None where the service does not tell it."""
    with contextlib.suppress(RequestRefused):
        return client.scan(scan_id)["filename"]
    return None


def delete(ctx: typer.Context, survey_id: SurveyId) -> None:
    """Remove a survey with its results."""
    terminal: Terminal = ctx.obj
    name = f"survey {survey_id}"
    terminal.delete(lambda client: client.delete_survey(survey_id), name, survey_id=survey_id)


def download(
    ctx: typer.Context,
    survey_id: SurveyId,
    to: Annotated[
        Path | None,
        typer.Option(help="Folder; left out: one that is named like the survey.", file_okay=False),
    ] = None,
    laz: Annotated[
        bool, typer.Option("--laz", help="The cloud as LAZ, in a ninth to a quarter of the bytes.")
    ] = False,
) -> None:
    """Fetch what a survey found: cloud, picture, tiles and objects. What was broken off is taken up, also by another run."""
    terminal: Terminal = ctx.obj
    folder = to or Path(survey_id)
    with terminal.client() as client:
        survey = client.survey(survey_id)
        refused = survey["status"] == "failed" and _placed(survey) == "refused"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            names = ("picture.png",) if refused else ("cloud.laz" if laz else "cloud.ply", "picture.png")
            files = [
                terminal.download(client, f"/surveys/{survey_id}/{name}", folder / name) for name in names
            ]
            if not refused:
                files += _features(client, survey, folder)
        except OSError as error:
            raise ClientError(f"{folder}: cannot be written ({error.strerror})") from error
    if survey["status"] == "failed":
        terminal.note(f"survey {survey_id} failed: {failure(survey)}")
    document: dict[str, Any] = {"survey_id": survey_id, "files": {path.name: str(path) for path in files}}
    terminal.show(document, lambda told: "\n".join(told["files"].values()))


def _features(client: Client, survey: SurveyDocument, folder: Path) -> Iterator[Path]:
    """Write tiles and, where the survey tells any, objects as GeoJSON, all pages in one. Raises OSError."""
    pages: dict[str, Document] = {"tiles": client.tiles(survey["survey_id"])}
    if survey["objects"] is not None:
        pages["objects"] = client.survey_objects(survey["survey_id"], limit=OBJECTS_PAGE)
    for name, first in pages.items():
        features = list(first["features"])
        page: Document | None = first
        while page := client.next_page(page):
            features += page["features"]
        whole = {**first, "features": features, "numberReturned": len(features), "links": []}
        path = folder / f"{name}.geojson"
        path.write_text(json.dumps(whole))
        yield path


def changes(
    ctx: typer.Context,
    map_id: MapId,
    change: Annotated[str | None, typer.Option(help="This one alone.")] = None,
    survey: Annotated[str | None, typer.Option(help="Of this survey only.")] = None,
    state: Annotated[
        str | None, typer.Option(help="changed, unchanged, inconsistent or unobserved; left out: changed.")
    ] = None,
    kind: Annotated[str | None, typer.Option(help="appeared or disappeared.")] = None,
    device_id: Annotated[str | None, typer.Option("--device-id", help="Seen by this device.")] = None,
    bbox: Annotated[str | None, typer.Option(help="4 or 6 numbers with commas, map frame, metres.")] = None,
    datetime: Annotated[str | None, typer.Option(help="Instant or interval, `..` for open.")] = None,
    min_score: Annotated[float | None, typer.Option("--min-score", help="Probability of change.")] = None,
    repeats: Annotated[bool, typer.Option("--repeats", help="Once for each visit that saw it.")] = False,
    limit: Annotated[int | None, typer.Option(min=1, help="At most so many; 100, of --csv all.")] = None,
    csv: Annotated[bool, typer.Option("--csv", help="As CSV on stdout, the names of columns first.")] = False,
) -> None:
    """The changed tiles of a map, each change once, newest first."""
    terminal: Terminal = ctx.obj
    if csv and terminal.as_json:
        raise ClientError("--csv and --json are two forms of the same; leave one out")
    most = CSV_PAGE if csv else 100
    frame = None if bbox is None else "map"  # else the Earth's, of a map that has an anchor
    filters = {
        "change": change,
        "survey": survey,
        "state": state,
        "kind": kind,
        "device_id": device_id,
        "bbox": bbox,
        "bbox-crs": frame,
        "datetime": datetime,
        "min_score": min_score,
    }
    filters["limit"] = most if limit is None else min(limit, most) if csv else limit
    if repeats:
        filters["repeats"] = True
    if csv:
        with terminal.client() as client:
            rows = client.changes_csv(map_id, **filters)
            for line in itertools.islice(rows, None if limit is None else limit + 1):
                terminal.line(line)
        return
    terminal.ask(lambda client: client.changes(map_id, **filters), _change_table)


def _table(surveys: Sequence[Document]) -> Table:
    table = columns("survey", "status", "captured", "scans", "placement", "found, or why it failed")
    for one in surveys:
        found = failure(one) if one["status"] == "failed" else counts(one)
        row = (one["survey_id"], one["status"], one.get("captured_at"), _scans(one), placement(one), found)
        table.add_row(*row)
    return table


def _scans(survey: Document) -> str:
    """Write how many scans a survey has, and how many of them were placed once it has ended."""
    scans, placed = survey.get("scan_count", len(survey.get("scans", []))), survey.get("accepted_count")
    return str(scans) if survey["status"] == "running" or placed is None else f"{placed} of {scans} placed"


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
            "warnings": warnings(survey),
            "failed": failure(survey),
        }
        if survey["status"] == "ready":
            rows |= {
                "cloud": f"{here}/cloud.ply",
                "picture": f"{here}/picture.png",
                "features": f"{here}/tiles",
            }
            if survey.get("objects") is not None:
                rows["things"] = f"{here}/objects"
        elif _placed(survey) == "refused":
            rows["picture"] = f"{here}/picture.png"
        names = ("survey", "map", "status", "captured", "model", "threshold")
        return Group(facts({**survey, **about}, *names, **rows), scan_table(survey))

    return draw


def _placed(survey: Document) -> str | None:
    """Return the state of a survey's placement, of a refused one the picture tells why."""
    return (survey.get("placement") or {}).get("state")


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
