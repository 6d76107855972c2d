"""Events: what was told, read in the order of publication, and swept when it is old."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Generic, NamedTuple, TypeVar, cast

from sqlalchemy import ColumnElement, CursorResult, delete, exists, func, or_, select
from sqlalchemy.orm import Session

from service.catalog.records import EventRecord, EventType
from service.catalog.sql.database import Database
from service.catalog.sql.tables import Event, EventLog, Map
from service.errors import Gone, NotFound

T = TypeVar("T")
_CURSOR = re.compile(r"[0-9]{1,18}(-[0-9]{1,18})?")


@dataclass(frozen=True, kw_only=True, slots=True)
class EventFilter:
    """Which events are asked for; None takes all."""

    types: Collection[EventType] | None = None
    maps: Collection[str] | None = None  #: of these maps; what is of no map is then left out

    def takes(self, event: EventRecord) -> bool:
        """Tell whether an event is asked for."""
        of_type = self.types is None or event.type in self.types
        return of_type and (self.maps is None or event.map_id in self.maps)

    def conditions(self) -> tuple[ColumnElement[bool], ...]:
        """Return the same for the database."""
        of_type = () if self.types is None else (Event.type.in_(self.types),)
        return of_type if self.maps is None else (*of_type, Event.map_id.in_(self.maps))


ALL = EventFilter()


@dataclass(frozen=True, kw_only=True, slots=True)
class EventPage:
    """Some events behind a cursor, in order."""

    items: tuple[EventRecord, ...]
    cursor: int  #: where to go on: behind the last of them, or behind all that there are


class FeedCursor(NamedTuple):
    """How far a reader has followed the changes or the objects of a map, in numbers of publication."""

    told: int  #: what was told first up to this number
    since: int  #: what was told anew, or withdrawn, up to this event

    @classmethod
    def read(cls, text: str) -> FeedCursor:
        """Read what `str()` wrote, or `0` for the beginning. Raises ValueError."""
        told, _, since = text.partition("-")
        if not _CURSOR.fullmatch(text):
            raise ValueError(f"{text[:40]!r} is no cursor; give that of an earlier answer, or 0")
        return cls(int(told), int(since or told))

    def __str__(self) -> str:
        return str(self.told) if self.told == self.since else f"{self.told}-{self.since}"


class Withdrawn(NamedTuple):
    """A change or an object that is told no more, or not under these filters."""

    sequence: int  #: of the event that says so
    subject: str  #: its id
    merged_into: (
        str | None
    )  #: the change that it turned out to be; None: no visit sees it, or it is an object
    filtered: bool = False  #: it is still told, and not what the filters ask for any more


@dataclass(frozen=True, kw_only=True, slots=True)
class Published(Generic[T]):
    """Some changes or objects behind a cursor: what was told anew since, then what was told first, in that order."""

    items: tuple[T, ...]
    updated: int  #: so many of them, at the front, were told before
    withdrawn: tuple[Withdrawn, ...]  #: of this map, whether or not a filter took it
    matched: int  #: behind the cursor, those of later answers among them
    cursor: FeedCursor  #: where to go on, also where nothing was told
    more: bool  #: whether there is something behind it by now


class Events:
    """The events of the catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def check_map(self, map_id: str) -> None:
        """Raise NotFound for a map that neither is there nor has an event that is kept, as one that was deleted has."""
        with self._database.read() as session:
            require_known(session, map_id)

    def last(self) -> int:
        """Return the number of the latest event, 0 before the first."""
        with self._database.read() as session:
            return extent(session)[1]

    def after(self, cursor: int, wanted: EventFilter = ALL, *, limit: int = 100) -> EventPage:
        """Return the next events behind a cursor; 0 is the beginning of what is kept.

        Raises Gone where some behind it are not kept any more, and for a cursor that is ahead of every event.
        """
        query = select(Event).where(Event.sequence > cursor, *wanted.conditions()).order_by(Event.sequence)
        with self._database.snapshot() as session:
            last = check_cursor(session, cursor)
            rows = session.scalars(query.limit(limit))
            items = tuple(EventRecord.of_row(row) for row in rows)
        return EventPage(items=items, cursor=items[-1].sequence if len(items) == limit else last)

    def find(self, event_id: str) -> EventRecord | None:
        """Return one event; None where it is not known, or not kept any more."""
        with self._database.read() as session:
            row = session.scalar(select(Event).where(Event.event_id == event_id))
            return None if row is None else EventRecord.of_row(row)

    def sweep(self, before: datetime) -> int:
        """Remove the events that were published before an instant; returns how many."""
        with self._database.write() as session:
            log = session.scalar(select(EventLog).with_for_update())
            swept = session.scalar(select(func.max(Event.sequence)).where(Event.created < before))
            if log is None or swept is None:
                return 0
            log.swept = swept
            gone = session.execute(delete(Event).where(Event.sequence <= swept))
            return cast("CursorResult[Any]", gone).rowcount


def require_known(session: Session, map_id: str) -> None:
    """Raise NotFound for a map of which there is nothing to tell, now or from what is kept."""
    there = exists().where(Map.map_id == map_id)
    if not session.scalar(select(or_(there, exists().where(Event.map_id == map_id)))):
        raise NotFound(f"no map {map_id!r}; GET /maps lists those there are")


def extent(session: Session) -> tuple[int, int]:
    """Return the number of the latest event that was swept, and of the latest of all; 0 where there is none."""
    row = session.execute(select(EventLog.swept, EventLog.last)).one_or_none()
    return (0, 0) if row is None else (row.swept, row.last)


def withdrawn(
    session: Session, type: EventType, map_id: str, after: FeedCursor, *, limit: int
) -> list[Withdrawn]:
    """Return what was withdrawn of a map behind a cursor; nothing for who begins, and knows of nothing yet."""
    if after == FeedCursor(0, 0):
        return []
    query = select(Event.sequence, Event.subject, Event.data).where(
        Event.map_id == map_id, Event.sequence > after.since, Event.type == type
    )
    rows = session.execute(query.order_by(Event.sequence).limit(limit))
    return [Withdrawn(sequence, subject, data.get("merged_into")) for sequence, subject, data in rows]


def check_cursor(session: Session, cursor: int) -> int:
    """Return the number of the latest event. Raises Gone for a cursor behind which something is missing."""
    swept, last = extent(session)
    if 0 < cursor < swept:
        raise Gone(
            f"events up to {swept} are not kept any more, and the cursor {cursor} is behind that; begin anew with after=0"
        )
    if cursor > last:
        raise Gone(
            f"the cursor {cursor} is ahead of the latest event, {last}: the database was put back to an earlier state; "
            "begin anew with after=0"
        )
    return last
