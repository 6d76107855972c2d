"""What the shell completes beside commands and options: ids, asked of the service, which has a second to answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from service.client import Client, ClientError, Retries

ONCE = Retries(attempts=1)
MOST = 100  #: ids that are offered

Found = list[tuple[str, str]]  #: id, and what it is


def maps(ctx: typer.Context, incomplete: str) -> Found:
    """Offer the ids of maps."""
    return _offer(ctx, incomplete, lambda c: [(one["map_id"], one["name"] or "") for one in c.maps()])


def scans(ctx: typer.Context, incomplete: str) -> Found:
    """Offer the ids of scans."""
    return _offer(ctx, incomplete, lambda c: [(one["scan_id"], one["filename"]) for one in c.scans()])


def jobs(ctx: typer.Context, incomplete: str) -> Found:
    """Offer the ids of jobs."""
    return _offer(ctx, incomplete, lambda c: [(one["jobID"], one["status"]) for one in c.jobs()])


def surveys(ctx: typer.Context, incomplete: str) -> Found:
    """Offer the ids of surveys, of every map."""
    return _offer(
        ctx,
        incomplete,
        lambda c: [
            (one["survey_id"], f"{one['map_id']} {one['captured_at']}")
            for known in c.maps()
            for one in c.surveys(known["map_id"])
        ],
    )


def models(ctx: typer.Context, incomplete: str) -> Found:
    """Offer models as requests name them."""
    return _offer(
        ctx, incomplete, lambda c: [(f"{one['name']}/{one['version']}", one["summary"]) for one in c.models()]
    )


MapId = Annotated[str, typer.Argument(autocompletion=maps)]
ScanId = Annotated[str, typer.Argument(autocompletion=scans)]
SurveyId = Annotated[str, typer.Argument(autocompletion=surveys)]


def _offer(ctx: typer.Context, incomplete: str, ask: Callable[[Client], Found]) -> Found:
    """Return what begins with what was typed; nothing where the service does not tell, for this is no place to say so."""
    try:
        with Client(ctx.find_root().params["url"], retries=ONCE, timeout_s=1.0) as client:
            known = ask(client)
    except (ClientError, KeyError, TypeError):
        return []
    return [one for one in known if one[0].startswith(incomplete)][:MOST]
