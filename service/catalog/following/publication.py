"""Publication: what happened is told in the transaction in which it happens, and numbered in the order of commits.

`tell` only notes. The numbers are taken when the transaction commits, from one row that stays locked until it has: who
comes later gets later numbers, and is seen later. (A sequence of PostgreSQL gives no such promise: a transaction that
took a smaller number may be seen after one that took a larger, and a reader that has gone on misses it.) A transaction
that is rolled back gives its numbers back, so there is no gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import event, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.catalog import tallies
from service.catalog.records import EventType
from service.catalog.sql.tables import Event, EventLog, MapObject, TileChange, new_id, now

_NOTED = "events"  #: where a session keeps what its transaction tells
_LOG_ID = 1

Published = type[TileChange] | type[MapObject]
Column = Literal[
    "published", "updated"
]  #: which takes a number: that of the first telling, or of the last since


@dataclass(frozen=True, kw_only=True, slots=True)
class _Told:
    """An event that has no number yet."""

    type: EventType
    subject: str
    map_id: str | None
    data: dict[str, Any]
    publishes: Published | None  #: whose row of this id takes the number
    column: Column


def tell(
    session: Session,
    type: EventType,
    subject: str,
    *,
    map_id: str | None = None,
    publishes: Published | None = None,
    column: Column = "published",
    **data: Any,
) -> None:
    """Tell that something happened to `subject` (an id), if the session's transaction commits.

    `data` is JSON. With `publishes` the row of that table whose id is `subject` takes the event's number in `column`.
    """
    told: list[_Told] | None = session.info.get(_NOTED)
    if told is None:
        told = session.info[_NOTED] = []
        tallies.noted_in(session)  # locks its rows before ours, in every transaction: nobody waits crosswise
        event.listen(session, "before_commit", _number)
    about = data if map_id is None else {"map_id": map_id, **data}
    told.append(
        _Told(type=type, subject=subject, map_id=map_id, data=about, publishes=publishes, column=column)
    )


def _number(session: Session) -> None:
    """Write what was told. Everything else has been sent by then: the log is locked as briefly as can be."""
    told: list[_Told] = session.info[_NOTED]
    if not told:
        return
    session.flush()
    first = _taken(session, len(told)) + 1
    instant = now()
    numbers: dict[tuple[Published, Column], list[dict[str, Any]]] = {}
    for sequence, one in enumerate(told, first):
        session.add(
            Event(
                sequence=sequence,
                event_id=new_id("event"),
                type=one.type,
                map_id=one.map_id,
                subject=one.subject,
                data=one.data,
                created=instant,
            )
        )
        if one.publishes is not None:
            key = "change_id" if one.publishes is TileChange else "object_id"
            row = {key: one.subject, one.column: sequence}
            numbers.setdefault((one.publishes, one.column), []).append(row)
    told.clear()
    for (table, _), rows in numbers.items():
        session.execute(update(table), rows)


def _taken(session: Session, count: int) -> int:
    """Take the next numbers for this transaction; returns the one before them."""
    of_dialect = postgresql if session.get_bind().dialect.name == "postgresql" else sqlite
    statement: Any = of_dialect.insert(EventLog).values(log_id=_LOG_ID, last=count, swept=0)
    statement = statement.on_conflict_do_update(
        index_elements=[EventLog.log_id], set_={"last": EventLog.last + count}
    )
    last: int = session.execute(statement.returning(EventLog.last)).scalar_one()
    return last - count
