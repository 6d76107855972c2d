"""The tables, as migrations/ makes them (a test compares the two).

Attributes bear the names of the records' fields, so that `Record.of_row` reads a row as it is.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

from sqlalchemy import (
    JSON,
    BigInteger,
    DateTime,
    ForeignKey,
    Index,
    MetaData,
    String,
    TypeDecorator,
    UniqueConstraint,
    func,
    select,
)
from sqlalchemy.engine import Dialect
from sqlalchemy.ext.associationproxy import AssociationProxy, association_proxy
from sqlalchemy.orm import DeclarativeBase, Mapped, column_property, mapped_column, relationship

NAMING = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "fk": "fk_%(table_name)s_%(column_0_N_name)s",
    "pk": "pk_%(table_name)s",
}


def now() -> datetime:
    """Return this instant, with its zone."""
    return datetime.now(UTC)


def new_id(kind: str) -> str:
    """Return a fresh id such as `survey-4f0c...`; it is opaque to clients."""
    return f"{kind}-{uuid4().hex}"


class UtcDateTime(TypeDecorator[datetime]):
    """An instant; kept in UTC, and given back with its zone, which SQLite forgets."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Convert to UTC; a time without a zone is a mistake of ours."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value.isoformat()} has no time zone")
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        """Convert from UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Base of every table."""

    metadata = MetaData(naming_convention=NAMING)
    type_annotation_map = {  # noqa: RUF012 - read by SQLAlchemy
        datetime: UtcDateTime(),
        dict[str, Any]: JSON(none_as_null=True),
        dict[str, int]: JSON(none_as_null=True),
        dict[str, float]: JSON(none_as_null=True),
        dict[str, str]: JSON(none_as_null=True),
        list[list[float]]: JSON(none_as_null=True),
        list[list[list[float]]]: JSON(none_as_null=True),
        list[str]: JSON(none_as_null=True),
        list[dict[str, Any]]: JSON(none_as_null=True),
        str: String(),
    }


class Scan(Base):
    """An uploaded file."""

    __tablename__ = "scans"

    scan_id: Mapped[str] = mapped_column("id", primary_key=True)
    filename: Mapped[str]
    format: Mapped[str]
    size: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str]
    device_id: Mapped[str | None]
    captured_at: Mapped[datetime | None]
    pose: Mapped[list[list[float]] | None]
    frame: Mapped[str | None]
    key: Mapped[str]
    warnings: Mapped[list[dict[str, Any]] | None]
    created: Mapped[datetime]
    resent: Mapped[datetime | None]

    __table_args__ = (Index(None, "created", "id"),)


class Outcome:
    """The columns that `version_scans` and `survey_scans` share."""

    ordinal: Mapped[int]
    pose: Mapped[list[list[float]] | None]
    accepted: Mapped[bool | None]
    fitness: Mapped[float | None]
    rmse: Mapped[float | None]
    map_from_scan: Mapped[list[list[float]] | None]
    translation_sigma: Mapped[float | None]
    rotation_sigma: Mapped[float | None]
    path: Mapped[list[str] | None]
    confidence: Mapped[float | None]
    reason: Mapped[str | None]
    detail: Mapped[str | None]
    numbers: Mapped[dict[str, float] | None]
    candidates: Mapped[list[list[list[float]]] | None]
    warnings: Mapped[list[dict[str, Any]] | None]


class VersionScan(Outcome, Base):
    """A scan of a version of a map."""

    __tablename__ = "version_scans"

    job_id: Mapped[str] = mapped_column(
        ForeignKey("map_versions.job_id", ondelete="CASCADE"), primary_key=True
    )
    scan_id: Mapped[str] = mapped_column(ForeignKey("scans.id"), primary_key=True, index=True)


class SurveyScan(Outcome, Base):
    """A scan of a survey."""

    __tablename__ = "survey_scans"

    survey_id: Mapped[str] = mapped_column(ForeignKey("surveys.id", ondelete="CASCADE"), primary_key=True)
    scan_id: Mapped[str] = mapped_column(ForeignKey("scans.id"), primary_key=True, index=True)


class MapVersion(Base):
    """One state of a map, known by the job that builds it."""

    __tablename__ = "map_versions"

    job_id: Mapped[str] = mapped_column(primary_key=True)
    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"))
    version: Mapped[int] = mapped_column("number")
    status: Mapped[str]
    base_version: Mapped[int | None]
    survey_id: Mapped[str | None]  # no foreign key: what a version was made from may be deleted since
    bounds: Mapped[dict[str, Any] | None]
    counts: Mapped[dict[str, int]]
    registration: Mapped[dict[str, Any] | None]
    tileset: Mapped[dict[str, Any] | None]  #: None of what earlier releases built
    created: Mapped[datetime]
    updated: Mapped[datetime]

    scans: Mapped[list[VersionScan]] = relationship(
        order_by=VersionScan.ordinal, cascade="all, delete-orphan", passive_deletes=True
    )
    scan_count: Mapped[int] = column_property(
        select(func.count())
        .where(VersionScan.job_id == job_id)
        .correlate_except(VersionScan)
        .scalar_subquery(),
        deferred=True,
    )
    of_map: Mapped[Map] = relationship()
    job: Mapped[Job | None] = relationship(
        primaryjoin="foreign(MapVersion.job_id) == Job.job_id", viewonly=True
    )
    model: AssociationProxy[str] = association_proxy("of_map", "model")
    settings: AssociationProxy[dict[str, Any]] = association_proxy("of_map", "settings")
    problem: AssociationProxy[dict[str, Any] | None] = association_proxy("job", "problem")

    __table_args__ = (UniqueConstraint("map_id", "number"), Index(None, "map_id", "created", "job_id"))


class Map(Base):
    """A reference map: what holds for all of its versions."""

    __tablename__ = "maps"

    map_id: Mapped[str] = mapped_column("id", primary_key=True)
    name: Mapped[str | None]
    model: Mapped[str]
    settings: Mapped[dict[str, Any]]
    anchor: Mapped[dict[str, float] | None]
    objects: Mapped[dict[str, int] | None]  # by status; NULL until a survey's end has counted them
    created: Mapped[datetime]
    updated: Mapped[datetime]

    __table_args__ = (Index(None, "created", "id"),)


class Survey(Base):
    """A visit compared with a map."""

    __tablename__ = "surveys"

    survey_id: Mapped[str] = mapped_column("id", primary_key=True)
    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"))
    map_version: Mapped[int] = mapped_column(server_default="1")
    status: Mapped[str]
    model: Mapped[str]
    asked_threshold: Mapped[float | None]
    threshold: Mapped[float | None]
    device_id: Mapped[str | None]
    captured_at: Mapped[datetime]
    warnings: Mapped[list[dict[str, Any]] | None]
    placement: Mapped[dict[str, Any] | None]
    counts: Mapped[dict[str, int]]
    objects: Mapped[dict[str, int] | None]
    moving: Mapped[int | None]
    tileset: Mapped[dict[str, Any] | None]
    job_id: Mapped[str]
    created: Mapped[datetime]
    updated: Mapped[datetime]

    scans: Mapped[list[SurveyScan]] = relationship(
        order_by=SurveyScan.ordinal, cascade="all, delete-orphan", passive_deletes=True
    )
    scan_count: Mapped[int] = column_property(
        select(func.count())
        .where(SurveyScan.survey_id == survey_id)
        .correlate_except(SurveyScan)
        .scalar_subquery(),
        deferred=True,
    )
    accepted_count: Mapped[int] = column_property(
        select(func.count())
        .where(SurveyScan.survey_id == survey_id, SurveyScan.accepted.is_(True))
        .correlate_except(SurveyScan)
        .scalar_subquery(),
        deferred=True,
    )
    job: Mapped[Job | None] = relationship(primaryjoin="foreign(Survey.job_id) == Job.job_id", viewonly=True)
    problem: AssociationProxy[dict[str, Any] | None] = association_proxy("job", "problem")

    __table_args__ = (Index(None, "map_id", "captured_at", "id"), Index(None, "map_id", "created", "id"))


class SurveyTile(Base):
    """The result of one tile of a survey."""

    __tablename__ = "survey_tiles"

    survey_id: Mapped[str] = mapped_column(ForeignKey("surveys.id", ondelete="CASCADE"), primary_key=True)
    tile_id: Mapped[str] = mapped_column(primary_key=True)
    i: Mapped[int]
    j: Mapped[int]
    k: Mapped[int]
    min_x: Mapped[float]
    min_y: Mapped[float]
    min_z: Mapped[float]
    max_x: Mapped[float]
    max_y: Mapped[float]
    max_z: Mapped[float]
    state: Mapped[str]
    score: Mapped[float | None]
    p_unchanged: Mapped[float | None]
    p_changed: Mapped[float | None]
    p_different: Mapped[float | None]
    n_reference: Mapped[int]
    n_current: Mapped[int]
    observed_share: Mapped[float | None]
    appeared: Mapped[int | None]
    disappeared: Mapped[int | None]
    told_by: Mapped[str | None]  # the survey whose tile of this id is told in `tile_changes`

    __table_args__ = (Index(None, "survey_id", "state", "score"),)

    @property
    def tile_index(self) -> tuple[int, int, int]:
        """Cell of the grid."""
        return self.i, self.j, self.k

    @property
    def bounds(self) -> dict[str, tuple[float, float, float]]:
        """Box in the map frame, metres."""
        return {"min": (self.min_x, self.min_y, self.min_z), "max": (self.max_x, self.max_y, self.max_z)}

    @property
    def probabilities(self) -> tuple[float | None, ...] | None:
        """Unchanged, changed, different place; None where the tile was not observed."""
        if self.p_unchanged is None:
            return None
        return self.p_unchanged, self.p_changed, self.p_different


class TileChange(Base):
    """A change of one tile over all surveys that saw it stay, told as the tile of one of them."""

    __tablename__ = "tile_changes"

    change_id: Mapped[str] = mapped_column("id", primary_key=True)
    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"))
    survey_id: Mapped[str]  # whose tile tells it; no foreign key: another one tells it where that is deleted
    tile_id: Mapped[str]
    first_seen: Mapped[datetime]
    last_seen: Mapped[datetime]
    max_score: Mapped[float]
    published: Mapped[int] = mapped_column(
        BigInteger, server_default="0"
    )  #: number of the event that told it
    updated: Mapped[int] = mapped_column(
        BigInteger, server_default="0"
    )  #: number of the event that told it last, where what is known of it changed since

    __table_args__ = (
        Index(None, "survey_id", "tile_id"),
        Index(None, "map_id", "published"),
        Index(None, "map_id", "updated"),
    )


class SurveyObject(Base):
    """A thing that a survey found changed: one sighting of an object of the map."""

    __tablename__ = "survey_objects"

    survey_id: Mapped[str] = mapped_column(ForeignKey("surveys.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str]
    now: Mapped[dict[str, Any] | None]
    before: Mapped[dict[str, Any] | None]
    motion: Mapped[dict[str, Any] | None]
    probability: Mapped[float]
    observed_share: Mapped[float]
    scans_seen_through: Mapped[int]
    object_id: Mapped[str | None] = mapped_column(index=True)  # no foreign key: `map_objects` is written anew


class MapObject(Base):
    """A changed thing of a map over all of its surveys, as far as its latest sighting and the latest look tell.

    Of what moved the latest sighting may tell one side alone; then another one, of the same survey or an earlier one,
    tells the other side.
    """

    __tablename__ = "map_objects"

    object_id: Mapped[str] = mapped_column("id", primary_key=True)
    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"))
    kind: Mapped[str]
    status: Mapped[str]
    last_known: Mapped[str]
    transient: Mapped[bool]
    first_seen: Mapped[datetime]
    last_seen: Mapped[datetime]
    last_looked: Mapped[datetime]
    accepted_in_version: Mapped[int | None]
    sightings: Mapped[int]
    survey_id: Mapped[str]
    number: Mapped[int]
    other_survey_id: Mapped[str | None]
    other_number: Mapped[int | None]
    probability: Mapped[float]
    min_x: Mapped[float]
    min_y: Mapped[float]
    min_z: Mapped[float]
    max_x: Mapped[float]
    max_y: Mapped[float]
    max_z: Mapped[float]
    created: Mapped[datetime]
    published: Mapped[int] = mapped_column(
        BigInteger, server_default="0"
    )  #: number of the event that told it
    updated: Mapped[int] = mapped_column(
        BigInteger, server_default="0"
    )  #: number of the event that told it last, where what became of it changed since

    __table_args__ = (
        Index(None, "map_id", "first_seen", "id"),
        Index(None, "map_id", "published"),
        Index(None, "map_id", "updated"),
    )


class Acceptance(Base):
    """What a version took over of a survey; it outlives both, for later surveys do not find it changed any more."""

    __tablename__ = "acceptances"

    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"), primary_key=True)
    version: Mapped[int] = mapped_column("number", primary_key=True)
    tiles: Mapped[list[str]]
    objects: Mapped[list[dict[str, Any]]]


class Model(Base):
    """A model that was trained on a map, known by the job that trains it."""

    __tablename__ = "models"

    job_id: Mapped[str] = mapped_column(primary_key=True)
    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"), index=True)
    map_version: Mapped[int]
    name: Mapped[str]
    version: Mapped[int] = mapped_column("number")
    status: Mapped[str]
    base: Mapped[str | None]
    minutes: Mapped[float]
    epochs: Mapped[int | None]
    card: Mapped[dict[str, Any] | None]
    created: Mapped[datetime]
    updated: Mapped[datetime]

    __table_args__ = (UniqueConstraint("name", "number"),)


class Job(Base):
    """A job as clients see it; the queue's own record is never asked."""

    __tablename__ = "jobs"

    job_id: Mapped[str] = mapped_column("id", primary_key=True)
    kind: Mapped[str]
    map_id: Mapped[str] = mapped_column(ForeignKey("maps.id", ondelete="CASCADE"), index=True)
    survey_id: Mapped[str | None] = mapped_column(ForeignKey("surveys.id", ondelete="CASCADE"), index=True)
    model: Mapped[str | None]
    status: Mapped[str] = mapped_column(index=True)
    message: Mapped[str]
    progress: Mapped[int]
    problem: Mapped[dict[str, Any] | None]
    step: Mapped[str] = mapped_column(server_default="")  #: that is due or runs, see steps.py
    attempts: Mapped[int] = mapped_column(server_default="0")  #: of this step, lost by its own fault
    interruptions: Mapped[int] = mapped_column(server_default="0")  #: of this step, from outside
    due: Mapped[datetime | None]  #: since when, or from when on, the step may begin
    begun: Mapped[datetime | None]  #: when a worker began the step; None while it waits
    owner: Mapped[str | None]  #: who shares the workers with others: a device
    created: Mapped[datetime]
    started: Mapped[datetime | None]
    finished: Mapped[datetime | None]
    updated: Mapped[datetime]

    __table_args__ = (Index(None, "created", "id"),)


class Key(Base):
    """An API key; of its secret only the digest is kept."""

    __tablename__ = "keys"

    key_id: Mapped[str] = mapped_column("id", primary_key=True)
    name: Mapped[str]
    digest: Mapped[str]  #: SHA-256 of the secret, hexadecimal
    scopes: Mapped[list[str]]
    maps: Mapped[list[str] | None]  #: ids of the maps that it is bound to; None: all
    created: Mapped[datetime]
    expires: Mapped[datetime | None]
    revoked: Mapped[datetime | None]

    __table_args__ = (Index("ix_keys_digest", "digest", unique=True),)


class IdempotencyKey(Base):
    """A request under a key that its client chose, and what it was answered."""

    __tablename__ = "idempotency_keys"

    owner: Mapped[str] = mapped_column(primary_key=True)  #: id of the API key; empty: none
    route: Mapped[str] = mapped_column(primary_key=True)  #: method and template of the path
    key: Mapped[str] = mapped_column(primary_key=True)
    fingerprint: Mapped[str]  #: of what was asked
    status: Mapped[int | None]
    headers: Mapped[dict[str, str] | None]
    body: Mapped[dict[str, Any] | None]
    job_id: Mapped[str | None]  # no foreign key: the answer outlives what it tells of
    under_way: Mapped[datetime | None]  #: since when, while what it made may still be taken back
    created: Mapped[datetime]

    __table_args__ = (Index(None, "created"),)


class Tally(Base):
    """A count and a sum under a name and labels, for metrics that outlive processes."""

    __tablename__ = "tallies"

    name: Mapped[str] = mapped_column(primary_key=True)
    labels: Mapped[str] = mapped_column(primary_key=True)  #: JSON object, keys in order
    count: Mapped[int] = mapped_column(BigInteger)
    total: Mapped[float]


class Event(Base):
    """Something that happened, numbered in the order in which it could be seen."""

    __tablename__ = "events"

    sequence: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    event_id: Mapped[str] = mapped_column("id")
    type: Mapped[str]
    map_id: Mapped[str | None]  # no foreign key: that a map was deleted is told after it
    subject: Mapped[str]  #: id of what it is about
    data: Mapped[dict[str, Any]]
    created: Mapped[datetime]

    __table_args__ = (Index(None, "map_id", "sequence"), Index(None, "created"))


class EventLog(Base):
    """One row: how far the events are numbered, and how far they were swept; none before the first event."""

    __tablename__ = "event_log"

    log_id: Mapped[int] = mapped_column("id", primary_key=True, autoincrement=False)
    last: Mapped[int] = mapped_column(
        BigInteger
    )  #: number of the latest event; its row is locked while one is added
    swept: Mapped[int] = mapped_column(
        BigInteger, server_default="0"
    )  #: the latest that is not kept any more


class Webhook(Base):
    """An address that events are sent to, and how far they were."""

    __tablename__ = "webhooks"

    webhook_id: Mapped[str] = mapped_column("id", primary_key=True)
    url: Mapped[str]
    types: Mapped[list[str] | None]  #: None: all
    map_id: Mapped[str | None]  #: None: all; no foreign key: that the map was deleted is sent as well
    secret: Mapped[str]  #: as it was shown: a signature needs it
    previous_secret: Mapped[str | None]
    previous_until: Mapped[datetime | None]  #: how long that signs as well
    status: Mapped[str]
    reason: Mapped[str | None]  #: why it is disabled, or what it missed
    position: Mapped[int] = mapped_column(BigInteger)  #: number of the last event that it needs no more
    attempts: Mapped[int]  #: that failed, at the event behind it
    next_attempt: Mapped[datetime]
    claim: Mapped[str | None]  #: of the process that sends to it now
    claimed_until: Mapped[datetime | None]
    created: Mapped[datetime]
    updated: Mapped[datetime]

    __table_args__ = (Index(None, "created", "id"),)


class WebhookDelivery(Base):
    """An event that was sent to a webhook, or is to be."""

    __tablename__ = "webhook_deliveries"

    delivery_id: Mapped[str] = mapped_column("id", primary_key=True)
    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"))
    kind: Mapped[str]
    event_id: Mapped[str]
    type: Mapped[str]
    status: Mapped[str]
    attempts: Mapped[int]
    answered: Mapped[int | None]  #: HTTP status of the last answer
    error: Mapped[str | None]  #: why the last attempt failed
    created: Mapped[datetime]
    updated: Mapped[datetime]

    __table_args__ = (Index(None, "webhook_id", "created", "id"), Index(None, "status"))
