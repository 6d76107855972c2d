"""Housekeeping: what the API does by itself once an hour. Several APIs may do so at once."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from datetime import timedelta

from fastapi.concurrency import run_in_threadpool

from service.api.http.dependencies import Services
from service.catalog.files import retention
from service.catalog.sql.tables import now

log = logging.getLogger(__name__)

FIRST_S = 60.0  #: after the start, which is busy enough
INTERVAL_S = 3600.0


@contextlib.asynccontextmanager
async def housekeeping(services: Services) -> AsyncIterator[None]:
    """Sweep from time to time while the block lasts."""
    task = asyncio.create_task(_repeat(services))
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def _repeat(services: Services) -> None:
    await asyncio.sleep(FIRST_S)
    while True:
        try:
            await run_in_threadpool(sweep, services)
        except Exception:  # the next hour is another chance, whatever it was
            log.exception("the sweep failed")
        await asyncio.sleep(INTERVAL_S)


def sweep(services: Services) -> None:
    """Remove old events, and what retention lets go; nothing of that where more files have no row than kills leave."""
    before = now() - timedelta(days=services.settings.keep_events_days)
    services.catalog.webhooks.sweep(before)
    if events := services.catalog.events.sweep(before):
        log.info("swept %d events", events)
    policy = retention.policy_of(services.settings, now())
    found = retention.find(services.catalog, policy)
    if found.doubtful:
        log.warning(
            "%d folders of files have no row in the database and %d have one: nothing was swept; if this is the right "
            "database, `spicd sweep --dry-run` lists them and `spicd sweep --force` removes them",
            len(found.folders),
            found.folders_known,
        )
        return
    swept = retention.remove(services.catalog, policy, found)
    if any(swept.values()):
        log.info("swept %(surveys)d surveys, %(scans)d scans and %(folders)d folders without a row", swept)
