"""Feeds: changes or objects of a map in the order in which they were told, for readers that come back with a cursor.

A cursor is two numbers of publication. What was told first goes by one: each row once, whatever becomes of it, so that
a reader can tell what is new to him. What was told anew or withdrawn goes by the other: of the rows that the reader has
had, those whose number `updated` lies behind it. Both are told as they are at the moment of reading, so the second
number may jump to the present with each answer that leaves nothing out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from sqlalchemy import Select, and_, func, select
from sqlalchemy.orm import Session

from service.catalog.following.events import FeedCursor, Published, Withdrawn, check_cursor, withdrawn
from service.catalog.records import EventType
from service.catalog.sql.tables import MapObject, TileChange

T = TypeVar("T")


def read_feed(
    session: Session,
    matching: Select[*tuple[Any, ...]],
    table: type[TileChange] | type[MapObject],
    record: Callable[..., T],
    *,
    map_id: str,
    after: FeedCursor,
    limit: int,
) -> Published[T]:
    """Return at most `limit` rows of `matching` behind a cursor, and as many withdrawn; the last element of each is its row of `table`.

    First what was told before and anew since, and in `withdrawn` what of it `matching` does not take (any more); then,
    where all of that was said, what is new. `session` sees one state of all tables. Raises Gone.
    """
    last = check_cursor(session, after.since)
    is_new, is_known = table.published > after.told, table.published <= after.told
    known_anew = and_(is_known, table.updated > after.since)
    lost = _lost(session, table, map_id, after, limit + 1)
    whole = len(lost) <= limit
    until = last if whole else lost[limit - 1].sequence
    anew = session.execute(matching.where(known_anew, table.updated <= until).order_by(table.updated)).all()
    shown = {_id(row[-1]) for row in anew}
    room = limit - len(anew) if whole else 0
    new = session.execute(matching.where(is_new).order_by(table.published).limit(room)).all() if room else []
    n_new = _count(session, matching.where(is_new))
    more = not whole or n_new > len(new)
    told = last if not more else new[-1][-1].published if new else after.told
    return Published(
        items=tuple(record(*row) for row in (*anew, *new)),
        updated=len(anew),
        withdrawn=tuple(one for one in lost[:limit] if one.subject not in shown),
        matched=n_new + _count(session, matching.where(known_anew)),
        cursor=FeedCursor(told, until),
        more=more,
    )


def _lost(
    session: Session,
    table: type[TileChange] | type[MapObject],
    map_id: str,
    after: FeedCursor,
    limit: int,
) -> list[Withdrawn]:
    """Return what was withdrawn, and what was told anew as if no filter took it, in the order of publication."""
    type: EventType = "change.withdrawn" if table is TileChange else "object.withdrawn"
    key = TileChange.change_id if table is TileChange else MapObject.object_id
    query = select(table.updated, key).where(
        table.map_id == map_id, table.published <= after.told, table.updated > after.since
    )
    rows = session.execute(query.order_by(table.updated).limit(limit))
    anew = [Withdrawn(sequence, subject, None, filtered=True) for sequence, subject in rows]
    return sorted([*withdrawn(session, type, map_id, after, limit=limit), *anew])[:limit]


def _id(row: TileChange | MapObject) -> str:
    return row.change_id if isinstance(row, TileChange) else row.object_id


def _count(session: Session, query: Select[Any, Any, Any]) -> int:
    return session.scalar(select(func.count()).select_from(query.subquery())) or 0
