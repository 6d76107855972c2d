"""Which of several representations a client gets."""

from __future__ import annotations

import pytest
from fastapi import Request

from service.api.http.answering.negotiation import preferred
from service.errors import NotAcceptable

OFFERS = ("application/geo+json", "application/json", "text/csv")


def asking(*accept: str) -> Request:
    headers = [(b"accept", value.encode()) for value in accept]
    return Request({"type": "http", "method": "GET", "path": "/", "headers": headers, "query_string": b""})


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        ((), "application/geo+json"),
        (("",), "application/geo+json"),
        (("*/*",), "application/geo+json"),
        (("text/csv",), "text/csv"),
        (("text/*",), "text/csv"),
        (("application/*, text/csv;q=0.9",), "application/geo+json"),
        (("application/json;q=0.5, text/csv;q=0.8",), "text/csv"),
        (("application/json;q=0.5", "text/csv;q=0.8"), "text/csv"),  # of two headers
        (("text/html,application/xhtml+xml,*/*;q=0.8",), "application/geo+json"),  # a browser
        (("application/geo+json;q=0, */*",), "application/json"),
        (("TEXT/CSV",), "text/csv"),
        (("nonsense",), "application/geo+json"),
    ],
)
def test_the_heaviest_of_what_there_is_wins_and_the_first_of_equals(
    accept: tuple[str, ...], expected: str
) -> None:
    assert preferred(asking(*accept), OFFERS) == expected


@pytest.mark.parametrize("accept", ["image/png", "*/*;q=0", "text/csv;q=0, text/html"])
def test_where_nothing_fits_it_says_what_there_is(accept: str) -> None:
    with pytest.raises(NotAcceptable, match="application/geo"):
        preferred(asking(accept), OFFERS)
