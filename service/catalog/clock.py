"""Instants: always UTC, written as RFC 3339 with Z."""

from __future__ import annotations

from datetime import UTC, datetime
from uuid import uuid4


def now() -> datetime:
    """This instant, with its zone."""
    return datetime.now(UTC)


def rfc3339(instant: datetime) -> str:
    """`2026-03-01T12:00:00.250000Z`; the fraction only where there is one."""
    return instant.astimezone(UTC).isoformat().replace("+00:00", "Z")


def new_id(kind: str) -> str:
    """A fresh id such as `survey-4f0c...`; opaque to clients."""
    return f"{kind}-{uuid4().hex}"
