"""Which times are told as odd."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from service.catalog.sql.clock import AHEAD, clock_warnings

NOW = datetime(2026, 3, 4, 12, tzinfo=UTC)


@pytest.mark.parametrize("given", [None, NOW, NOW - timedelta(days=3000), NOW + AHEAD])
def test_a_likely_time_is_not_told(given: datetime | None) -> None:
    assert clock_warnings(given, received=NOW) == ()


@pytest.mark.parametrize("given", [datetime(1970, 1, 1, tzinfo=UTC), datetime(2010, 1, 1, tzinfo=UTC)])
def test_a_clock_that_was_never_set_is_told(given: datetime) -> None:
    (warning,) = clock_warnings(given, received=NOW)
    assert warning.reason == "clock"
    assert f"captured_at is {given.year}-01-01T00:00:00Z, before 2010" in warning.detail


@pytest.mark.parametrize(
    ("ahead", "said"),
    [
        (timedelta(minutes=6), "6 minutes"),
        (timedelta(hours=3), "3 hours"),
        (timedelta(days=9), "9 days"),
        (timedelta(days=26_700), "73 years"),
    ],
)
def test_a_clock_that_is_ahead_is_told_by_how_much(ahead: timedelta, said: str) -> None:
    (warning,) = clock_warnings(NOW + ahead, received=NOW)
    assert f", {said} after it was received (2026-03-04T12:00:00Z)" in warning.detail
    assert warning.numbers == {"seconds": ahead.total_seconds()}
