"""Objects: the things that surveys found changed, each once over all visits to a map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from sqlalchemy import Select, and_, exists, func, select
from sqlalchemy.orm import aliased

from service.catalog.findings.feeds import read_feed
from service.catalog.following.events import FeedCursor, Published
from service.catalog.records import (
    Bounds,
    MapObjectRecord,
    ObjectKind,
    ObjectRecord,
    ObjectStatus,
    SightingRecord,
)
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.sql.keyset import Key, Order, Values, behind, order_by
from service.errors import NotFound

_OBJECT, _SIGHTING, _SURVEY = tables.MapObject, tables.SurveyObject, tables.Survey
#: Every sighting with its survey and the object that it is of.
_SIGHTINGS = (
    select(_SIGHTING, _SURVEY, _OBJECT)
    .join(_SURVEY, _SURVEY.survey_id == _SIGHTING.survey_id)
    .outerjoin(_OBJECT, _OBJECT.object_id == _SIGHTING.object_id)
)
_OTHER = aliased(tables.SurveyObject)
#: Every object with its latest sighting, and the one that tells its other side.
_LATEST = (
    select(_SIGHTING, _OTHER, _SURVEY, _OBJECT)
    .join(_SURVEY, _SURVEY.survey_id == _SIGHTING.survey_id)
    .join(_OBJECT, and_(_OBJECT.survey_id == _SIGHTING.survey_id, _OBJECT.number == _SIGHTING.number))
    .outerjoin(
        _OTHER,
        and_(_OTHER.survey_id == _OBJECT.other_survey_id, _OTHER.number == _OBJECT.other_number),
    )
)


#: What objects of a map may be ordered by; with a minus: downwards.
ObjectSort = Literal[
    "first_seen", "-first_seen", "last_seen", "-last_seen", "last_looked", "-last_looked",
    "probability", "-probability",
]  # fmt: skip
SightingSort = Literal["number", "-number", "probability", "-probability"]


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectFilter:
    """Which objects of a map are asked for; None takes all."""

    map_id: str
    kind: ObjectKind | None = None
    status: ObjectStatus | None = None
    last_known: ObjectStatus | None = None
    transient: bool | None = None
    survey_id: str | None = None  #: that saw it
    device_id: str | None = None  #: of one at least of the surveys that saw it
    bounds: Bounds | None = None  #: map frame; an object is in when its box meets this one
    since: datetime | None = None  #: last seen at or after
    until: datetime | None = None  #: first seen at or before
    min_probability: float | None = None  #: 0..1, inclusive


@dataclass(frozen=True, kw_only=True, slots=True)
class SightingFilter:
    """Which objects of a survey are asked for; None takes all."""

    survey_id: str
    kind: ObjectKind | None = None
    bounds: Bounds | None = (
        None  #: map frame; an object is in when the box of where it is shown meets this one
    )
    min_probability: float | None = None  #: 0..1, inclusive


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectPage:
    """Some objects of a map."""

    items: tuple[MapObjectRecord, ...]
    matched: int  #: of all pages together
    following: Values | None  #: behind which row the next page starts, None at the end


@dataclass(frozen=True, kw_only=True, slots=True)
class SightingPage:
    """Some objects of a survey."""

    items: tuple[SightingRecord, ...]
    matched: int  #: of all pages together
    following: Values | None  #: behind which row the next page starts, None at the end


class Objects:
    """The objects of the catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(
        self,
        wanted: ObjectFilter,
        *,
        sort: ObjectSort = "-first_seen",
        after: Values | None = None,
        limit: int = 100,
    ) -> ObjectPage:
        """Return objects of a map, those first that were first seen last where no order is given."""
        query, order = _matching(wanted), object_order(sort)
        count = select(func.count()).select_from(query.subquery())
        rows = query if after is None else query.where(behind(order, after))
        rows = rows.add_columns(*(key.column for key in order)).order_by(*order_by(order)).limit(limit + 1)
        with self._database.read() as session:
            matched = session.scalar(count) or 0
            read: list[tuple[MapObjectRecord, Values]] = [
                (_record(*row[:4]), tuple(row[4:])) for row in session.execute(rows)
            ]
        items = tuple(record for record, _ in read[:limit])
        return ObjectPage(
            items=items, matched=matched, following=read[limit - 1][1] if len(read) > limit else None
        )

    def published(
        self, wanted: ObjectFilter, *, after: FeedCursor, limit: int = 100
    ) -> Published[MapObjectRecord]:
        """Return objects behind a cursor in the order of publication: what was told anew, then what is new.

        Raises Gone.
        """
        matching = _matching(wanted)
        with self._database.snapshot() as session:
            return read_feed(
                session, matching, _OBJECT, _record, map_id=wanted.map_id, after=after, limit=limit
            )

    def get(self, map_id: str, object_id: str) -> tuple[MapObjectRecord, tuple[SightingRecord, ...]]:
        """Return one object and the sighting of each survey that saw it, in order of time. Raises NotFound."""
        this = (_OBJECT.map_id == map_id, _OBJECT.object_id == object_id)
        seen = _SIGHTINGS.where(*this, _SURVEY.status == "ready")
        seen = seen.order_by(_SURVEY.captured_at, _SURVEY.survey_id, _SIGHTING.number)
        with self._database.read() as session:
            latest = session.execute(_LATEST.where(*this)).one_or_none()
            if latest is None:
                raise NotFound(
                    f"no object {object_id!r} of map {map_id!r}; GET /maps/{map_id}/objects lists them"
                )
            by_survey: dict[str, list[SightingRecord]] = {}
            for row in session.execute(seen):
                by_survey.setdefault(row[1].survey_id, []).append(_sighting(*row))
            return _record(*latest), tuple(_one(sightings) for sightings in by_survey.values())

    def of_survey(
        self,
        wanted: SightingFilter,
        *,
        sort: SightingSort = "number",
        after: Values | None = None,
        limit: int = 100,
    ) -> SightingPage:
        """Return objects of a survey; there are few, and where each is shown is not in columns of its own."""
        query = _SIGHTINGS.where(_SIGHTING.survey_id == wanted.survey_id)
        if wanted.kind is not None:
            query = query.where(_SIGHTING.kind == wanted.kind)
        if wanted.min_probability is not None:
            query = query.where(_SIGHTING.probability >= wanted.min_probability)
        with self._database.read() as session:
            records = [_sighting(*row) for row in session.execute(query)]
        place = _place_in(sort)
        found = [one for one in records if wanted.bounds is None or _meets(one.thing, wanted.bounds)]
        found.sort(key=place)
        further = [one for one in found if after is None or place(one) > _signed(sort, after)]
        following = _signed(sort, place(further[limit - 1])) if len(further) > limit else None
        return SightingPage(items=tuple(further[:limit]), matched=len(found), following=following)


def object_order(sort: ObjectSort) -> Order:
    """Return the keys that the objects of a map are ordered by; of equal ones the id goes the same way."""
    name, down = sort.removeprefix("-"), sort.startswith("-")
    kind: type[datetime] | type[float] = float if name == "probability" else datetime
    return (
        Key(column=getattr(_OBJECT, name), type=kind, descending=down),
        Key(column=_OBJECT.object_id, type=str, descending=down),
    )


def sighting_order(sort: SightingSort) -> tuple[type[float] | type[int], type[int]]:
    """Return the types of the values that tell where a page of a survey's objects ended."""
    return (float if sort.endswith("probability") else int), int


def _place_in(sort: SightingSort) -> Callable[[SightingRecord], tuple[float, int]]:
    """Return what to order sightings by, upwards: a number, then their own."""
    name, sign = sort.removeprefix("-"), -1 if sort.startswith("-") else 1
    return lambda one: (sign * getattr(one.thing, name), one.thing.number)


def _signed(sort: SightingSort, place: Values) -> Values:
    """Return a place with the value itself for what it is ordered by, or the other way round."""
    value, number = place
    return (-value if sort.startswith("-") else value), number  # type: ignore[operator]


def _meets(thing: ObjectRecord, bounds: Bounds) -> bool:
    """Tell whether the box of where an object is shown meets another."""
    shown = thing.now or thing.before
    if shown is None:
        return False
    box = shown.bounds
    return all(a <= b for a, b in zip(box.min, bounds.max, strict=True)) and all(
        a >= b for a, b in zip(box.max, bounds.min, strict=True)
    )


def _matching(
    wanted: ObjectFilter,
) -> Select[tables.SurveyObject, tables.SurveyObject, tables.Survey, tables.MapObject]:
    query = _LATEST.where(_OBJECT.map_id == wanted.map_id)
    if wanted.kind is not None:
        query = query.where(_OBJECT.kind == wanted.kind)
    if wanted.status is not None:
        query = query.where(_OBJECT.status == wanted.status)
    if wanted.last_known is not None:
        query = query.where(_OBJECT.last_known == wanted.last_known)
    if wanted.transient is not None:
        query = query.where(_OBJECT.transient.is_(wanted.transient))
    if wanted.survey_id is not None or wanted.device_id is not None:
        query = query.where(_seen_by(wanted))
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


def _seen_by(wanted: ObjectFilter) -> Any:
    """Return the condition that an object was seen by the survey, and by a survey of the device, that are asked for."""
    sighting, survey = aliased(tables.SurveyObject), aliased(tables.Survey)
    same = (sighting.object_id == _OBJECT.object_id, sighting.survey_id == survey.survey_id)
    seen = exists().where(*same, survey.status == "ready")
    if wanted.survey_id is not None:
        seen = seen.where(survey.survey_id == wanted.survey_id)
    if wanted.device_id is not None:
        seen = seen.where(survey.device_id == wanted.device_id)
    return seen


def _record(
    latest: tables.SurveyObject,
    other: tables.SurveyObject | None,
    survey: tables.Survey,
    row: tables.MapObject,
) -> MapObjectRecord:
    own: dict[str, Any] = {
        name: getattr(row, name) for name in MapObjectRecord.model_fields if name != "latest"
    }
    sighting = _sighting(latest, survey, row)
    if other is not None:
        thing = sighting.thing.with_side_of(ObjectRecord.of_row(other))
        sighting = sighting.model_copy(update={"thing": thing})
    return MapObjectRecord(**own, latest=sighting)


def _one(of_survey: Sequence[SightingRecord]) -> SightingRecord:
    """Return what one survey says of an object: where it told its sides as two things, the one that is there, with both."""
    shown, *others = sorted(of_survey, key=lambda seen: seen.thing.now is None)
    thing = shown.thing
    for other in others:
        thing = thing.with_side_of(other.thing)
    return shown.model_copy(update={"thing": thing})


def _sighting(row: tables.SurveyObject, survey: tables.Survey, of: tables.MapObject | None) -> SightingRecord:
    return SightingRecord(
        thing=ObjectRecord.of_row(row),
        object_id=row.object_id,
        map_id=survey.map_id,
        map_version=survey.map_version,
        survey_id=survey.survey_id,
        device_id=survey.device_id,
        model=survey.model,
        captured_at=survey.captured_at,
        first_seen=None if of is None else of.first_seen,
    )
