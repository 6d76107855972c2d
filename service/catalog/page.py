"""One page of a list, newest first, by keyset: stable while rows are added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Generic, TypeVar

from sqlalchemy import Select, tuple_
from sqlalchemy.orm import InstrumentedAttribute

T = TypeVar("T")
Position = tuple[datetime, str]  #: `created` and id of the last row that was shown


@dataclass(frozen=True, kw_only=True, slots=True)
class Page(Generic[T]):
    """Some rows of a longer list."""

    items: Sequence[T]
    more: bool  #: whether a further page has anything


def newest_first(
    query: Select[Any],
    created: InstrumentedAttribute[datetime],
    key: InstrumentedAttribute[str],
    *,
    after: Position | None,
    limit: int,
) -> Select[Any]:
    """`query` in order, behind `after`, with one row more than `limit` to tell whether there is more."""
    if after is not None:
        query = query.where(tuple_(created, key) < after)
    return query.order_by(created.desc(), key.desc()).limit(limit + 1)


def page_of(rows: Sequence[T], limit: int) -> Page[T]:
    """The page in rows that were asked for by `newest_first`."""
    return Page(items=rows[:limit], more=len(rows) > limit)
