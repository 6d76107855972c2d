"""`spicd jobs`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table
from rich.text import Text

from service.cli.maps import facts
from service.cli.terminal import Terminal, columns
from service.client import ClientError, Document, sentence

_STYLES = {"successful": "green", "failed": "red", "dismissed": "yellow", "running": "cyan"}


def register(commands: typer.Typer) -> None:
    """Add `jobs` to the command line."""
    commands.command("jobs")(jobs)


def jobs(
    ctx: typer.Context,
    job_id: Annotated[str | None, typer.Argument(help="One job; left out: all.")] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Stop it for good.")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Follow it to its end.")] = False,
) -> None:
    """Jobs, newest first, or one of them."""
    terminal: Terminal = ctx.obj
    if job_id is None and (cancel or wait):
        raise ClientError("name the job; `spicd jobs` lists them")
    with terminal.client() as client:
        if job_id is None:
            found = client.jobs()
            terminal.show(found, lambda: _table(found))
            return
        if cancel:
            job = client.dismiss(job_id)
        else:
            job = terminal.wait(client, job_id) if wait else client.job(job_id)
    terminal.show(job, lambda: _whole(job))


def _table(found: list[Document]) -> Table:
    table = columns("job", "kind", "status", "progress", "message", "created")
    for job in found:
        status = Text(job["status"], style=_STYLES.get(job["status"], ""))
        progress = f"{job.get('progress') or 0} %"
        table.add_row(
            job["jobID"],
            job.get("processID"),
            status,
            progress,
            Text(job.get("message") or ""),
            job.get("created"),
        )
    return table


def _whole(job: Document) -> Group:
    about = facts(
        [
            ("job", job["jobID"]),
            ("status", job["status"]),
            ("progress", f"{job.get('progress') or 0} %"),
            ("message", job.get("message")),
            ("created", job.get("created")),
            ("started", job.get("started")),
            ("finished", job.get("finished")),
        ]
    )
    problem = job.get("problem")
    return Group(about, Text(sentence(problem), style="red")) if problem else Group(about)
