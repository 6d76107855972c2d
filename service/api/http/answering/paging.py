"""Pages of lists: a limit, and an opaque cursor that says behind which row to go on."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Annotated, Any

from fastapi import Request as HttpRequest
from pydantic import Field

from service.api.http.answering.documents import Link, Request, link
from service.api.http.answering.json_text import read_json
from service.api.http.reading.fields import instant
from service.catalog.records import Page, Position, rfc3339
from service.catalog.sql.keyset import Value, Values
from service.errors import BadRequest

Limit = Annotated[int, Field(ge=1, le=1000, description="most items in one answer")]
Cursor = Annotated[
    str | None,
    Field(
        max_length=1000,
        description="from a `next` link; opaque, and refused with other filters than that has",
    ),
]


class PageRequest(Request):
    """Which part of a list."""

    limit: Limit = 100
    cursor: Cursor = None

    def after(self) -> Position | None:
        """Return where to go on. Raises BadRequest."""
        if self.cursor is None:
            return None
        created, key, of = decoded(self.cursor, instant, str, str)
        _check(of, self.filters())
        return created, key

    def filters(self) -> str:
        """Return which list it is a part of, in short."""
        return digest(self.model_dump(exclude={"limit", "cursor"}))


def list_links(
    request: HttpRequest, asked: PageRequest, page: Page[Any], position: Callable[[Any], Position]
) -> list[Link]:
    """Return the links `self`, and `next` while there is more."""
    links = [Link(href=here(request), rel="self")]
    if page.more:
        created, key = position(page.items[-1])
        links.append(next_link(request, encoded(rfc3339(created), key, asked.filters())))
    return links


def next_link(request: HttpRequest, cursor: str, media_type: str = "application/json") -> Link:
    """Return the link to the same request, further on."""
    url = request.url.include_query_params(cursor=cursor)
    return link(request, f"{_path(request)}?{url.query}", "next", media_type)


def encoded(*parts: str) -> str:
    """Return an opaque cursor of these parts."""
    return base64.urlsafe_b64encode(json.dumps(parts).encode()).decode().rstrip("=")


def decoded(cursor: str, *readers: Callable[[str], Any]) -> Sequence[Any]:
    """Return the parts of a cursor, each as its reader reads it. Raises BadRequest."""
    try:
        parts = read_json(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
        return [read(_plain(part)) for read, part in zip(readers, parts, strict=True)]
    except (ValueError, TypeError, OverflowError) as error:
        raise BadRequest(f"cursor {cursor[:40]!r} is none of ours; follow a `next` link") from error


def digest(filters: object) -> str:
    """Return a few letters that differ where the filters of two lists do, whose `repr` says all of them."""
    return hashlib.sha256(repr(filters).encode()).hexdigest()[:12]


def _check(of: str, filters: str) -> None:
    """Raise BadRequest for a cursor of a list with other filters."""
    if of != filters:
        raise BadRequest(
            "the cursor is of a list with other filters; give it with the same parameters as before, or follow a `next` "
            "link, which has them"
        )


def encoded_values(sort: str, values: Values | None, filters: object) -> str | None:
    """Return the cursor behind the row with these values of a list in the order `sort`; None where there is no more.

    `filters` are those of the list, as a value whose `repr` says all of them.
    """
    if values is None:
        return None
    return encoded(sort, digest(filters), *(_written(value) for value in values))


def decoded_values(
    cursor: str | None,
    sort: str,
    types: Sequence[type[datetime] | type[float] | type[int] | type[str]],
    filters: object,
) -> Values | None:
    """Return the values behind which a list in the order `sort` goes on.

    Raises BadRequest, also for the cursor of another order, or of other filters.
    """
    if cursor is None:
        return None
    readers: list[Callable[[str], Any]] = [_READERS[kind] for kind in types]
    of, taken, *values = decoded(cursor, str, str, *readers)
    if of != sort:
        raise BadRequest(f"the cursor is of a list in another order than sortby={sort}; follow a `next` link")
    _check(taken, digest(filters))
    return tuple(values)


def _written(value: Value) -> str:
    if isinstance(value, datetime):
        return rfc3339(value)
    return float(value).hex() if isinstance(value, float) else str(value)


def finite(text: str) -> float:
    """Read a number as `float.hex` writes it. Raises ValueError and OverflowError."""
    number = float.fromhex(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is no number of ours")
    return number


def count(text: str) -> int:
    """Read a number of something, as a database keeps it. Raises ValueError."""
    if not text.isdigit() or len(text) > 9:
        raise ValueError(f"{text[:20]} is no number of ours")
    return int(text)


_READERS: dict[type, Callable[[str], Any]] = {datetime: instant, float: finite, int: count, str: str}


def _plain(part: object) -> str:
    """Return a part of a cursor: ours have letters of ASCII. Lone surrogates and NUL are none for a database."""
    if not isinstance(part, str) or not part.isascii() or not part.isprintable():
        raise ValueError("a part of it is no text of ours")
    return part


def _path(request: HttpRequest) -> str:
    return request.url.path.removeprefix(request.scope.get("root_path", ""))


def here(request: HttpRequest) -> str:
    """Return the path and query of a request, as a link to itself has them."""
    return request.url.path + (f"?{request.url.query}" if request.url.query else "")
