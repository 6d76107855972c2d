"""The clock of whoever sends: a time that cannot be right is taken and told, for the scan itself may be good."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from service.catalog.records import ScanWarning, rfc3339

#: Clocks that lost their battery start in 1970, 1980, 2000 or 2010, and GPS receivers that rolled over in 1980 to 2006.
EARLIEST = datetime(2010, 1, 3, tzinfo=UTC)
AHEAD = timedelta(minutes=5)  #: that a clock may be ahead of ours


def clock_warnings(captured_at: datetime | None, *, received: datetime) -> tuple[ScanWarning, ...]:
    """Tell of a time before the sensors were built, or after it was received; nothing of a likely one, or of none."""
    if captured_at is None:
        return ()
    told = f"captured_at is {rfc3339(captured_at)}"
    if captured_at < EARLIEST:
        detail = f"{told}, before {EARLIEST.year}, as of a clock that was never set; set the device's clock, and send the "
    elif captured_at > received + AHEAD:
        ahead = _length(captured_at - received)
        detail = f"{told}, {ahead} after it was received ({rfc3339(received)}); set the device's clock, and send the "
    else:
        return ()
    seconds = (captured_at - received).total_seconds()
    return (ScanWarning(reason="clock", detail=f"{detail}right time", numbers={"seconds": seconds}),)


def _length(span: timedelta) -> str:
    """Write a span as people would."""
    seconds = span.total_seconds()
    for unit, length in (("years", 31_557_600), ("days", 86_400), ("hours", 3600)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds / 60:.0f} minutes"
