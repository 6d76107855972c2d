"""What the routes work with: opened when the app starts, never at import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Protocol, cast

from fastapi import Depends, Request

from service.api.http.answering.cards import Cards
from service.api.http.guards.lanes import Lane
from service.api.http.guards.listeners import Listeners
from service.catalog.catalog import Catalog
from service.catalog.steps import JobKind
from service.dispatch import Dispatcher, Hands
from service.settings import Settings


class Queue(Hands, Protocol):
    """What the API asks of the job queue (`service.queue.JobQueue`)."""

    def dismiss(self, job_id: str, kind: JobKind) -> None:
        """Stop a job that waits or runs. Raises QueueUnavailable."""

    def ping(self) -> None:
        """Ask the queue for a sign of life. Raises QueueUnavailable."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Services:
    """One of each, for the life of the app."""

    settings: Settings
    catalog: Catalog
    queue: Queue
    dispatcher: Dispatcher
    cards: Cards
    writes: Lane  #: threads of what changes something; reads have the framework's
    listeners: Listeners  #: for events
    uploads: Lane  #: and of what takes files into the blob store besides, which lasts longer


async def _services(request: Request) -> Services:
    return cast("Services", request.app.state.services)


Provided = Annotated[Services, Depends(_services)]
