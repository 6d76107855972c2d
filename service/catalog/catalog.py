"""The catalog: everything that is recorded, opened once where a process (or a forked job) starts."""

from __future__ import annotations

from dataclasses import dataclass

from service.catalog.files.blobs import Blobs
from service.catalog.files.disk import BALLAST_BYTES, Disk
from service.catalog.findings import history
from service.catalog.findings.changes import Changes
from service.catalog.findings.objects import Objects
from service.catalog.following.deliveries import Deliveries
from service.catalog.following.events import Events
from service.catalog.following.webhooks import Webhooks
from service.catalog.jobs import Jobs
from service.catalog.keys import Keys
from service.catalog.maps import Maps
from service.catalog.models import Models
from service.catalog.scans import Scans
from service.catalog.sql.database import Database
from service.catalog.sql.patience import JOBS, REQUESTS, Patience
from service.catalog.surveys import Surveys
from service.catalog.versions import Versions
from service.settings import Settings


@dataclass(frozen=True, kw_only=True, slots=True)
class Catalog:
    """The database and the blobs, and the nouns that are kept in them."""

    database: Database
    blobs: Blobs
    disk: Disk
    scans: Scans
    maps: Maps
    versions: Versions
    surveys: Surveys
    models: Models
    changes: Changes
    objects: Objects
    events: Events
    webhooks: Webhooks
    deliveries: Deliveries
    jobs: Jobs
    keys: Keys

    def close(self) -> None:
        """Let go of every connection."""
        self.database.close()


def open_catalog(settings: Settings, *, migrate: bool = True, patience: Patience = JOBS) -> Catalog:
    """Open the catalog that `settings` name; `migrate` brings its tables up to date first.

    A process that forks opens the catalog in the child: a connection to PostgreSQL does not survive a fork. One that
    answers requests opens it with the patience of those, and keeps it open.
    """
    keep_open = patience is REQUESTS
    database = Database(settings.resolved_database_url(), patience=patience, keep_open=keep_open)
    disk = disk_of(settings)
    if migrate:
        disk.freeing(database.upgrade)  # where it is full, the log of the database alone may not fit
        history.catch_up(database)
    blobs = Blobs(settings.resolved_blob_url(), patience=patience)
    return Catalog(
        database=database,
        blobs=blobs,
        disk=disk,
        scans=Scans(database, blobs),
        maps=Maps(database, blobs),
        versions=Versions(database, blobs),
        surveys=Surveys(database, blobs),
        models=Models(database),
        changes=Changes(database),
        objects=Objects(database),
        events=Events(database),
        webhooks=Webhooks(database),
        deliveries=Deliveries(database),
        jobs=Jobs(database),
        keys=Keys(database),
    )


def disk_of(settings: Settings) -> Disk:
    """Return the disk of the data folder, with a ballast where the database lies on it."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    is_ours = settings.resolved_database_url().startswith("sqlite")
    return Disk(settings.data_dir, reserve=settings.min_free_bytes, ballast=BALLAST_BYTES if is_ours else 0)
