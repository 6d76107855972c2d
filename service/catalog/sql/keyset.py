"""Pages by keyset: a list in any order goes on behind the values of its last row, stable while rows are added.

Each order ends in keys that tell all rows apart, so that no row is told twice or left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, and_, or_
from sqlalchemy.orm import InstrumentedAttribute

Value = datetime | float | int | str
Values = tuple[Value, ...]  #: of the keys of one row


@dataclass(frozen=True, kw_only=True, slots=True)
class Key:
    """One of the columns that a list is ordered by; it is never NULL."""

    column: ColumnElement[Any] | InstrumentedAttribute[Any]
    type: type[datetime] | type[float] | type[int] | type[str]
    descending: bool = False


Order = tuple[Key, ...]


def order_by(order: Order) -> list[ColumnElement[Any]]:
    """Return what to order a query by."""
    return [key.column.desc() if key.descending else key.column.asc() for key in order]


def behind(order: Order, values: Sequence[Value]) -> ColumnElement[bool]:
    """Return the condition that a row comes after the one with these values."""
    same: list[ColumnElement[bool]] = []
    ways: list[ColumnElement[bool]] = []
    for key, value in zip(order, values, strict=True):
        further = key.column < value if key.descending else key.column > value
        ways.append(and_(*same, further))
        same.append(key.column == value)
    return or_(*ways)
