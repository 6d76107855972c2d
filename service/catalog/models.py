"""Models that a site trains on its own maps; those that come with a release lie in the model store."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import delete, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.catalog.idempotency import ANY_TIMES, Once
from service.catalog.jobs import new_job
from service.catalog.records import JobRecord, ModelRecord
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.sql.tables import Model, now
from service.catalog.versions import map_row, version_in_use
from service.errors import Conflict, NotFound


class Models:
    """The models of the catalog, each by its name and number."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self,
        map_id: str,
        *,
        minutes: float,
        name: str | None = None,
        base: str | None = None,
        epochs: int | None = None,
        once: Once = ANY_TIMES,
    ) -> tuple[ModelRecord, JobRecord]:
        """Record a model of a map's version in use, and its job; the next number of its name.

        Raises NotFound and NotReady (the map), Conflict where the same name is taken at this moment, and what `once` does.
        """
        name = name or name_for(map_id)
        try:
            with self._database.write() as session:
                once.claim(session)
                map_row(session, map_id, lock=True)  # nobody deletes the version meanwhile
                version = version_in_use(session, map_id)
                number = _next_number(session, name)
                job = new_job("model", map_id, model=f"{name}/{number}")
                row = Model(
                    job_id=job.job_id,
                    map_id=map_id,
                    map_version=version.version,
                    name=name,
                    version=number,
                    status="training",
                    base=base,
                    minutes=minutes,
                    epochs=epochs,
                    created=job.created,
                    updated=job.created,
                )
                session.add_all([row, job])
                session.flush()
                made = ModelRecord.of_row(row), JobRecord.of_row(job)
                once.keep(session, *made, job=job)
                return made
        except IntegrityError as error:
            raise Conflict(f"another training took the name {name!r} just now; try again") from error

    def find(
        self, name: str, version: int | None = None, maps: Collection[str] | None = None
    ) -> ModelRecord | None:
        """Find one model in whatever state, by default the newest that is ready, else the newest; None without one.

        With `maps` those alone that were trained on one of them.
        """
        query = select(Model).where(Model.name == name)
        if maps is not None:
            query = query.where(Model.map_id.in_(maps))
        if version is not None:
            query = query.where(Model.version == version)
        query = query.order_by(Model.status != "ready", Model.version.desc()).limit(1)
        with self._database.read() as session:
            row = session.scalar(query)
            return None if row is None else ModelRecord.of_row(row)

    def of_job(self, job_id: str) -> ModelRecord:
        """Return the model that a job trains. Raises NotFound, also where it was deleted since."""
        with self._database.read() as session:
            return ModelRecord.of_row(_row(session, job_id))

    def ready(self) -> tuple[ModelRecord, ...]:
        """Return every model that can score, by name, the newest of each first."""
        query = select(Model).where(Model.status == "ready")
        with self._database.read() as session:
            rows = session.scalars(query.order_by(Model.name, Model.version.desc()))
            return tuple(ModelRecord.of_row(row) for row in rows)

    def save_card(self, job_id: str, card: Mapping[str, Any]) -> None:
        """Record what was made, replacing an earlier run's card; `jobs.succeed` makes it ready. Raises NotFound."""
        with self._database.write() as session:
            row = _row(session, job_id)
            row.card = dict(card)
            row.updated = now()

    def take_back(self, job_id: str) -> None:
        """Delete a model whose job never reached the queue."""
        with self._database.write() as session:
            session.execute(delete(tables.Job).where(tables.Job.job_id == job_id))
            session.delete(_row(session, job_id))


def name_for(map_id: str) -> str:
    """Return the name of a map's models where none was given: `lobby-net`."""
    return f"{re.sub('^[^A-Za-z0-9]+', '', map_id)[:60] or 'site'}-net"


def _next_number(session: Session, name: str) -> int:
    return 1 + (session.scalar(select(func.max(Model.version)).where(Model.name == name)) or 0)


def _row(session: Session, job_id: str) -> Model:
    row = session.get(Model, job_id)
    if row is None:
        raise NotFound(f"job {job_id!r} trains no model, or it was deleted since")
    return row
