"""What the tests of the service put into the catalog, and a queue that only remembers.

The tests run on SQLite. With SPICD_TEST_DATABASE_URL (a PostgreSQL server, any database of it) each test makes a
database of its own there, and leaves it; where it says `postgresql` alone, a server is started for the tests.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, make_url, text

from service.api.app import create_app
from service.api.http.dependencies import Services
from service.catalog.catalog import Catalog
from service.catalog.records import (
    Bounds,
    Motion,
    ObjectKind,
    ObjectRecord,
    Place,
    ScanOutcome,
    ScanRecord,
    TileRecord,
    TileState,
)
from service.catalog.steps import Step
from service.errors import QueueUnavailable
from service.queue import Claim, QueueState, Snapshot
from service.settings import Settings

MODEL = "spicd-net/1"
IDENTITY = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)
BOUNDS = Bounds(min=(0, 0, 0), max=(3, 3, 1))


@dataclass
class RememberingQueue:
    """Stands in for the job queue."""

    submitted: list[tuple[str, str]] = field(default_factory=list)  #: job and step, as they came to wait
    dismissed: list[tuple[str, str]] = field(default_factory=list)
    state: QueueState = field(default_factory=lambda: QueueState(answering=tuple("abcdefgh")))
    down: bool = False

    def snapshot(self) -> Snapshot:
        self.ping()
        return Snapshot(queues={"geometry": self.state, "inference": self.state})

    def arrange(self, queue: str, wanted: Sequence[tuple[str, Step]]) -> None:
        self.ping()
        for job_id, step in wanted:
            if (job_id, step.name) not in self.submitted:
                self.submitted.append((job_id, step.name))

    def release(self, claims: Iterable[Claim]) -> None:
        self.ping()

    def drop_taken(self, queue: str, name: str) -> None:
        self.ping()

    def forget_worker(self, name: str) -> None:
        self.ping()

    def dismiss(self, job_id: str, kind: str) -> None:
        self.ping()
        self.dismissed.append((job_id, kind))

    def ping(self) -> None:
        if self.down:
            raise QueueUnavailable("the job queue does not answer")


def settings_in(folder: Path) -> Settings:
    """Everything in `folder`, with the card of one model, and bodies of at most 200 kB."""
    card = folder / "models" / "spicd-net" / "1" / "card.json"
    card.parent.mkdir(parents=True)
    card.write_text(json.dumps({"name": "spicd-net", "version": "1", "threshold": 0.5}))
    return Settings(
        data_dir=folder / "data",
        model_store=folder / "models",
        model=MODEL,
        max_upload_bytes=200_000,
        database_url=fresh_database(),
    )


def fresh_database() -> str | None:
    """A new database on the server that the environment names; None, which is SQLite, where it names none."""
    server = os.environ.get("SPICD_TEST_DATABASE_URL")
    if server is None:
        return None
    name = f"spicd_{uuid4().hex}"
    url = make_url(server).set(drivername="postgresql+psycopg")
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    engine.dispose()
    return url.set(database=name).render_as_string(hide_password=False)


@contextlib.contextmanager
def running(settings: Settings, queue: RememberingQueue) -> Iterator[TestClient]:
    """The API as its clients see it: an unexpected error is an answer, not an exception."""
    app = create_app(settings, queue=queue)
    with TestClient(app, base_url="http://localhost", raise_server_exceptions=False) as client:
        yield client


def catalog_of(client: TestClient) -> Catalog:
    """The catalog that the API works on; a worker would open the same folder."""
    return services_of(client).catalog


def services_of(client: TestClient) -> Services:
    """What the routes of the API work with."""
    return cast("Services", cast("FastAPI", client.app).state.services)


def ply(content: str = "hall") -> bytes:
    """Bytes that start as a PLY does; nothing in the API reads further."""
    return f"ply\nformat ascii 1.0\ncomment {content}\nend_header\n".encode()


def add_scan(catalog: Catalog, content: str = "hall", **known: Any) -> ScanRecord:
    """A scan in the catalog."""
    path = Path(catalog.blobs._root or ".") / f"{content}.part"
    path.write_bytes(ply(content))
    record, _ = catalog.scans.add(
        path, filename=f"{content}.ply", format="ply", size=len(ply(content)), sha256=content, **known
    )
    return record


def add_map(catalog: Catalog, map_id: str = "lobby", *, ready: bool = True) -> str:
    """A map of one scan, built or not; its job's id."""
    scan = add_scan(catalog, f"map-{map_id}")
    _, job = catalog.maps.create(scan_ids=[scan.scan_id], model=MODEL, map_id=map_id)
    if ready:
        accepted = ScanOutcome(
            scan_id=scan.scan_id, accepted=True, fitness=0.98, rmse=0.02, map_from_scan=IDENTITY
        )
        catalog.versions.save_result(
            job.job_id, outcomes=[accepted], bounds=BOUNDS, counts={"tiles": 4}, registration={"scans": 1}
        )
        catalog.jobs.succeed(job.job_id)
    return job.job_id


def add_version(
    catalog: Catalog, map_id: str = "lobby", *, survey_id: str | None = None, ready: bool = True
) -> str:
    """A further version of a map, of one new scan or of a survey, built or not; its job's id."""
    number = len(catalog.versions.page(map_id).items) + 1
    scan_ids = [] if survey_id else [add_scan(catalog, f"further-{map_id}-{number}").scan_id]
    version, job = catalog.versions.create(map_id, scan_ids=scan_ids, survey_id=survey_id)
    if ready:
        outcomes = [
            scan if scan.accepted else scan.model_copy(update={"accepted": True, "map_from_scan": IDENTITY})
            for scan in version.scans
        ]
        catalog.versions.save_result(
            job.job_id, outcomes=outcomes, bounds=BOUNDS, counts={"tiles": 4 + version.version}
        )
        catalog.jobs.succeed(job.job_id)
    return job.job_id


def tile(
    i: int, j: int, state: TileState = "changed", score: float = 0.9, *, observed_share: float | None = None
) -> TileRecord:
    """A tile of 1.5 x 1.5 x 1.0 m with its corner at (1.5 i, 1.5 j, 0)."""
    seen = state != "unobserved"
    return TileRecord(
        tile_id=f"tile_{i:03}_{j:03}_000",
        tile_index=(i, j, 0),
        bounds=Bounds(min=(1.5 * i, 1.5 * j, 0), max=(1.5 * i + 1.5, 1.5 * j + 1.5, 1)),
        state=state,
        score=score if seen else None,
        probabilities=(1 - score, score, 0) if seen else None,
        n_reference=900,
        n_current=800 if seen else 3,
        observed_share=observed_share,
    )


def place(x: float, y: float, *, size: tuple[float, float, float] = (0.5, 0.5, 0.9), yaw: float = 0) -> Place:
    """A box on the floor around (x, y), in one of the tiles of `tile`."""
    (dx, dy, height), volume = size, size[0] * size[1] * size[2]
    corners = ((-dx, -dy), (dx, -dy), (dx, dy), (-dx, dy))
    return Place(
        center=(x, y, height / 2),
        size=size,
        yaw=yaw,
        footprint=tuple((x + a / 2, y + b / 2) for a, b in corners),
        height_over_floor=0.0,
        volume=volume,
        voxels=round(volume / 0.05**3),
        points=4 * round(volume / 0.05**3),
        tiles=(f"tile_{int(x // 1.5):03}_{int(y // 1.5):03}_000",),
    )


def thing(
    number: int,
    *,
    now: Place | None = None,
    before: Place | None = None,
    probability: float = 0.9,
) -> ObjectRecord:
    """An object that appeared, disappeared or moved, as its places say."""
    kind: ObjectKind = "moved" if now and before else "appeared" if now else "disappeared"
    motion = None
    if now is not None and before is not None:
        dx, dy, dz = (a - b for a, b in zip(now.center, before.center, strict=True))
        motion = Motion(translation=(dx, dy, dz), yaw=now.yaw - before.yaw)
    return ObjectRecord(
        number=number,
        kind=kind,
        now=now,
        before=before,
        motion=motion,
        probability=probability,
        observed_share=0.8,
        scans_seen_through=3,
    )


def add_survey(
    catalog: Catalog,
    tiles: list[TileRecord] | None = None,
    *,
    map_id: str = "lobby",
    captured_at: datetime = NOON,
    ready: bool = True,
    objects: Sequence[ObjectRecord] | None = None,
    moving: int | None = None,
) -> tuple[str, str]:
    """A survey of one scan, done or not; its id and its job's."""
    scan = add_scan(catalog, f"visit-{captured_at.isoformat()}")
    record, job = catalog.surveys.create(
        map_id, scan_ids=[scan.scan_id], model=MODEL, captured_at=captured_at
    )
    if ready:
        catalog.surveys.save_result(
            record.survey_id, tiles=tiles or [], threshold=0.5, objects=objects, moving=moving
        )
        catalog.jobs.succeed(job.job_id)
    return record.survey_id, job.job_id
