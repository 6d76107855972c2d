"""`spicd jobs`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Group
from rich.table import Table
from rich.text import Text

from service.cli import completion
from service.cli.tables import columns, facts, stage
from service.cli.terminal import Terminal
from service.client import ClientError, Document, sentence

_STYLES = {"successful": "green", "failed": "red", "dismissed": "yellow", "running": "cyan"}


def jobs(
    ctx: typer.Context,
    job_id: Annotated[
        str | None, typer.Argument(help="One job; left out: all.", autocompletion=completion.jobs)
    ] = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Stop it for good.")] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Run a failed one again.")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Follow it to its end.")] = False,
) -> None:
    """Jobs, newest first, or one of them."""
    terminal: Terminal = ctx.obj
    if job_id is None and (cancel or retry or wait):
        raise ClientError("name the job; `spicd jobs` lists them")
    if job_id is None:
        terminal.ask(lambda client: client.jobs(), _table)
    elif cancel:
        terminal.ask(lambda client: client.dismiss(job_id), _whole)
    elif retry and not wait:
        terminal.ask(lambda client: client.retry(job_id), _whole)
    elif retry:
        terminal.ask(lambda client: terminal.wait(client, str(client.retry(job_id)["jobID"])), _whole)
    elif wait:
        terminal.ask(lambda client: terminal.wait(client, job_id), _whole)
    else:
        terminal.ask(lambda client: client.job(job_id), _whole)


def _table(jobs: Sequence[Document]) -> Table:
    table = columns("job", "kind", "status", "progress", "message", "created")
    for job in jobs:
        status = Text(job["status"], style=_STYLES.get(job["status"], ""))
        message = Text(stage(job) if job.get("queue_position") else job.get("message") or "")
        table.add_row(job["jobID"], job.get("processID"), status, _percent(job), message, job.get("created"))
    return table


def _whole(job: Document) -> Group:
    shown = {**job, "job": job["jobID"], "progress": _percent(job)}
    about = facts(
        {**shown, "queue": stage(job) if job.get("queue_position") else None},
        *("job", "status", "progress", "message", "queue", "created", "started", "finished"),
    )
    problem = job.get("problem")
    return Group(about, Text(sentence(problem), style="red")) if problem else Group(about)


def _percent(job: Document) -> str:
    return f"{job.get('progress') or 0} %"
