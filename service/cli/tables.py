"""Documents of the API as tables for people."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from service.client import Document

_ACCEPTED: dict[bool | None, Text] = {True: Text("yes", style="green"), False: Text("no", style="red")}


def columns(*names: str) -> Table:
    """Return an empty table that folds what is too long for it: an id that is cut is of no use."""
    table = Table()
    for name in names:
        table.add_column(name, overflow="fold")
    return table


def facts(document: Document, *names: str, **more: Any) -> Table:
    """Return two columns: the members of these `names` and `more`, without those that are not there."""
    table = Table(show_header=False, box=None)
    rows = {name: document.get(name) for name in names} | more
    for name, value in rows.items():
        if value not in (None, "", {}):
            table.add_row(Text(name, style="bold"), str(value))
    return table


def counts(document: Document, member: str = "counts") -> str:
    """Write counts as `changed 3, unchanged 40`; nothing where there are none."""
    return ", ".join(
        f"{name.replace('_', ' ')} {number}" for name, number in (document.get(member) or {}).items()
    )


def scan_table(document: Document) -> Table:
    """Return how each scan of a map, version or survey was registered, why it was left out, and what is odd about it."""
    scans = document.get("scans", [])
    file = ["file"] if any(scan.get("file") for scan in scans) else []
    table = columns(
        "scan",
        *file,
        "accepted",
        "fitness",
        "rmse (m)",
        "sigma (m)",
        "confidence",
        "reason",
        "detail, warnings",
    )
    for scan in scans:
        table.add_row(
            scan["scan_id"],
            *(scan.get(name) for name in file),
            _ACCEPTED.get(scan.get("accepted"), Text()),
            number(scan.get("fitness"), 2),
            number(scan.get("rmse"), 3),
            number(scan.get("translation_sigma"), 3),
            number(scan.get("confidence"), 2),
            words(scan.get("reason") or ""),
            "\n".join(filter(None, [scan.get("detail"), warnings(scan)])),
        )
    return table


def with_all_scans(document: Document, every: Callable[[], Sequence[Document]]) -> Document:
    """Return a map or version with all of its scans: those `every` gives where its document has the first ones alone."""
    told = document["scans"]
    return document if len(told) >= document.get("scan_count", 0) else {**document, "scans": list(every())}


def warnings(document: Document) -> str:
    """Write what is odd about a scan or a survey, each on a line of its own."""
    return "\n".join(f"{words(one['reason'])}: {one['detail']}" for one in document.get("warnings") or ())


def failure(document: Document) -> str:
    """Write why a map or a survey failed; nothing where it did not."""
    problem = document.get("problem") or {}
    return str(problem.get("detail") or problem.get("title") or "")


def placement(survey: Document) -> str:
    """Write how sure the placement of a survey is; nothing where nobody judged it."""
    told = survey.get("placement")
    if told is None:
        return ""
    confidence = told.get("confidence")
    return words(told["state"]) + ("" if confidence is None else f" (confidence {confidence:.2f})")


def stage(job: Document) -> str:
    """Write what a job does, or how long it has waited and which one it is in its queue."""
    position, waited_s = job.get("queue_position"), job.get("waiting_s")
    if position is None:
        return str(job.get("message") or job["status"])
    waited = "" if waited_s is None else f", for {waited_s:.0f} s so far"
    return f"waiting, number {position} in the queue{waited}"


def words(name: str) -> str:
    """Write a value of a list as words: `in_doubt` as `in doubt`."""
    return name.replace("_", " ")


def number(value: Any, digits: int) -> str:
    """Write a number, and nothing for what is none."""
    return f"{value:.{digits}f}" if isinstance(value, int | float) else ""


def point(values: list[float]) -> str:
    """Write coordinates in metres."""
    return ", ".join(number(value, 2) for value in values)
