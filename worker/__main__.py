"""Starts one worker: `python -m worker geometry` or `python -m worker inference`."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import logging
import sys

from redis import Redis

from service.catalog.database import Database
from service.catalog.jobs import Jobs
from service.catalog.records import Problem
from service.catalog.steps import ALLOWED_FUNCTIONS
from service.logs import set_up_logging
from service.settings import Settings
from service.up.lifetime import end_with_parent
from worker.rq_workers import GeometryWorker, InferenceWorker
from worker.threads import wait_passively

log = logging.getLogger("worker")

# Imported before the first fork, so that no step pays for it. Importing is all that may happen here: native work in
# the parent starts threads, and a fork among threads that hold locks deadlocks.
WARM_MODULES = {"geometry": ("open3d", "torch", "worker.jobs"), "inference": ("torch", "worker.jobs")}


def main(arguments: list[str] | None = None) -> int:
    """Work until told to stop; returns the exit status."""
    options = _parse(arguments)
    if options.parent:
        end_with_parent(options.parent)
    settings = Settings()
    set_up_logging(settings.log_level, settings.log_format)
    if settings.redis_url is None:
        print(
            "no queue to work on: set SPICD_REDIS_URL, or start everything with `spicd up`", file=sys.stderr
        )
        return 2
    wait_passively()
    for module in WARM_MODULES[options.queue]:
        importlib.import_module(module)
    log.info("%s worker is ready", options.queue)
    kind = GeometryWorker if options.queue == "geometry" else InferenceWorker
    kind(
        options.queue,
        Redis.from_url(settings.redis_url),
        allowed=ALLOWED_FUNCTIONS,
        records=CatalogRecords(settings.resolved_database_url()),
        grace_s=options.grace,
    ).work()
    return 0


class CatalogRecords:
    """Writes to the catalog how a step ended, first writer wins: what the step itself recorded stands.

    The database alone is opened, and closed again: the blob store starts threads, and this process forks.
    """

    def __init__(self, database_url: str) -> None:
        self._url = database_url

    def failed(self, job_id: str, code: str, sentence: str) -> bool:
        """Record that the job failed with this problem."""
        with self._database() as database:
            return Jobs(database).fail(job_id, Problem(code=code, detail=sentence))

    def lost(self, job_id: str, how: str) -> bool:
        """Count an attempt; whether to start the step again."""
        with self._database() as database:
            return Jobs(database).lose_attempt(job_id, how)

    def stopped(self, job_id: str) -> bool:
        """Record that the step waits for another worker; tell whether the job still wants it."""
        with self._database() as database:
            return Jobs(database).put_back(job_id)

    def _database(self) -> contextlib.closing[Database]:
        return contextlib.closing(Database(self._url))


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m worker", description=__doc__)
    parser.add_argument("queue", choices=sorted(WARM_MODULES))
    parser.add_argument(
        "--grace", type=float, default=8.0, help="seconds that a running step has after SIGTERM"
    )
    parser.add_argument(
        "--parent", type=int, default=0, help="end when the process with this id, the parent, ends"
    )
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
