"""Objects: the things that surveys found changed, each once over all visits to a map."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Select, and_, func, select, tuple_

from service.catalog import tables
from service.catalog.database import Database
from service.catalog.events import FeedCursor, Withdrawn, check_cursor, withdrawn
from service.catalog.records import (
    Bounds,
    MapObjectRecord,
    ObjectKind,
    ObjectRecord,
    ObjectStatus,
    Position,
    SightingRecord,
)
from service.errors import NotFound

_OBJECT, _SIGHTING, _SURVEY = tables.MapObject, tables.SurveyObject, tables.Survey
#: Every sighting with its survey and the object that it is of.
_SIGHTINGS = (
    select(_SIGHTING, _SURVEY, _OBJECT)
    .join(_SURVEY, _SURVEY.survey_id == _SIGHTING.survey_id)
    .outerjoin(_OBJECT, _OBJECT.object_id == _SIGHTING.object_id)
)
#: Every object with its latest sighting.
_LATEST = (
    select(_SIGHTING, _SURVEY, _OBJECT)
    .join(_SURVEY, _SURVEY.survey_id == _SIGHTING.survey_id)
    .join(_OBJECT, and_(_OBJECT.survey_id == _SIGHTING.survey_id, _OBJECT.number == _SIGHTING.number))
)


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectFilter:
    """Which objects of a map are asked for; None takes all."""

    map_id: str
    kind: ObjectKind | None = None
    status: ObjectStatus | None = None
    last_known: ObjectStatus | None = None
    transient: bool | None = None
    bounds: Bounds | None = None  #: map frame; an object is in when its box meets this one
    since: datetime | None = None  #: last seen at or after
    until: datetime | None = None  #: first seen at or before
    min_probability: float | None = None  #: 0..1, inclusive


@dataclass(frozen=True, kw_only=True, slots=True)
class SightingFilter:
    """Which objects of a survey are asked for; None takes all."""

    survey_id: str
    kind: ObjectKind | None = None
    min_probability: float | None = None  #: 0..1, inclusive


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectPage:
    """Some objects of a map, those first that were first seen last."""

    items: tuple[MapObjectRecord, ...]
    matched: int  #: of all pages together
    following: Position | None  #: behind which the next page starts, None at the end


@dataclass(frozen=True, kw_only=True, slots=True)
class PublishedObjects:
    """Some objects in the order in which they were first told."""

    items: tuple[MapObjectRecord, ...]
    withdrawn: tuple[Withdrawn, ...]  #: since the cursor, of this map, whether or not a filter took it
    matched: int  #: behind the cursor, those of later answers among them
    cursor: FeedCursor  #: where to go on, also where nothing was told


@dataclass(frozen=True, kw_only=True, slots=True)
class SightingPage:
    """Some objects of a survey, by number."""

    items: tuple[SightingRecord, ...]
    matched: int  #: of all pages together
    following: int | None  #: behind which number the next page starts, None at the end


class Objects:
    """The objects of the catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(self, wanted: ObjectFilter, *, after: Position | None = None, limit: int = 100) -> ObjectPage:
        """Return objects of a map."""
        query = _matching(wanted)
        count = select(func.count()).select_from(query.subquery())
        place = tuple_(_OBJECT.first_seen, _OBJECT.object_id)
        rows = query if after is None else query.where(place < after)
        rows = rows.order_by(_OBJECT.first_seen.desc(), _OBJECT.object_id.desc()).limit(limit + 1)
        with self._database.read() as session:
            matched = session.scalar(count) or 0
            records = [_record(*row) for row in session.execute(rows)]
        items = tuple(records[:limit])
        following = (items[-1].first_seen, items[-1].object_id) if len(records) > limit else None
        return ObjectPage(items=items, matched=matched, following=following)

    def published(self, wanted: ObjectFilter, *, after: FeedCursor, limit: int = 100) -> PublishedObjects:
        """Return objects behind a cursor in the order of publication, each once. Raises Gone."""
        query = _matching(wanted).where(_OBJECT.published > after.told)
        with self._database.snapshot() as session:
            last = check_cursor(session, after.withdrawn)
            matched = session.scalar(select(func.count()).select_from(query.subquery())) or 0
            rows = session.execute(query.order_by(_OBJECT.published).limit(limit)).all()
            gone = withdrawn(session, "object.withdrawn", wanted.map_id, after)
        told = rows[-1][2].published if matched > len(rows) else last
        return PublishedObjects(
            items=tuple(_record(*row) for row in rows),
            withdrawn=gone,
            matched=matched,
            cursor=FeedCursor(told, last),
        )

    def get(self, map_id: str, object_id: str) -> tuple[MapObjectRecord, tuple[SightingRecord, ...]]:
        """Return one object and every sighting of it, in order of time. Raises NotFound."""
        this = (_OBJECT.map_id == map_id, _OBJECT.object_id == object_id)
        seen = _SIGHTINGS.where(*this, _SURVEY.status == "ready")
        seen = seen.order_by(_SURVEY.captured_at, _SURVEY.survey_id, _SIGHTING.number)
        with self._database.read() as session:
            latest = session.execute(_LATEST.where(*this)).one_or_none()
            if latest is None:
                raise NotFound(
                    f"no object {object_id!r} of map {map_id!r}; GET /maps/{map_id}/objects lists them"
                )
            return _record(*latest), tuple(_sighting(*row) for row in session.execute(seen))

    def of_survey(
        self, wanted: SightingFilter, *, after: int | None = None, limit: int = 100
    ) -> SightingPage:
        """Return objects of a survey."""
        query = _SIGHTINGS.where(_SIGHTING.survey_id == wanted.survey_id)
        if wanted.kind is not None:
            query = query.where(_SIGHTING.kind == wanted.kind)
        if wanted.min_probability is not None:
            query = query.where(_SIGHTING.probability >= wanted.min_probability)
        count = select(func.count()).select_from(query.subquery())
        rows = query if after is None else query.where(_SIGHTING.number > after)
        rows = rows.order_by(_SIGHTING.number).limit(limit + 1)
        with self._database.read() as session:
            matched = session.scalar(count) or 0
            records = [_sighting(*row) for row in session.execute(rows)]
        items = tuple(records[:limit])
        following = items[-1].thing.number if len(records) > limit else None
        return SightingPage(items=items, matched=matched, following=following)


def _matching(
    wanted: ObjectFilter,
) -> Select[tables.SurveyObject, tables.Survey, tables.MapObject]:
    query = _LATEST.where(_OBJECT.map_id == wanted.map_id)
    if wanted.kind is not None:
        query = query.where(_OBJECT.kind == wanted.kind)
    if wanted.status is not None:
        query = query.where(_OBJECT.status == wanted.status)
    if wanted.last_known is not None:
        query = query.where(_OBJECT.last_known == wanted.last_known)
    if wanted.transient is not None:
        query = query.where(_OBJECT.transient.is_(wanted.transient))
    if wanted.since is not None:
        query = query.where(_OBJECT.last_seen >= wanted.since)
    if wanted.until is not None:
        query = query.where(_OBJECT.first_seen <= wanted.until)
    if wanted.min_probability is not None:
        query = query.where(_OBJECT.probability >= wanted.min_probability)
    if wanted.bounds is not None:
        low, high = wanted.bounds.min, wanted.bounds.max
        query = query.where(
            and_(_OBJECT.min_x <= high[0], _OBJECT.min_y <= high[1], _OBJECT.min_z <= high[2]),
            and_(_OBJECT.max_x >= low[0], _OBJECT.max_y >= low[1], _OBJECT.max_z >= low[2]),
        )
    return query


def _record(latest: tables.SurveyObject, survey: tables.Survey, row: tables.MapObject) -> MapObjectRecord:
    own: dict[str, Any] = {
        name: getattr(row, name) for name in MapObjectRecord.model_fields if name != "latest"
    }
    return MapObjectRecord(**own, latest=_sighting(latest, survey, row))


def _sighting(row: tables.SurveyObject, survey: tables.Survey, of: tables.MapObject | None) -> SightingRecord:
    return SightingRecord(
        thing=ObjectRecord.of_row(row),
        object_id=row.object_id,
        map_id=survey.map_id,
        map_version=survey.map_version,
        survey_id=survey.survey_id,
        model=survey.model,
        captured_at=survey.captured_at,
        first_seen=None if of is None else of.first_seen,
    )
