"""Reads JSON that clients send: every failure is a ValueError, and nothing in it may cost more than its length."""

from __future__ import annotations

import json
from typing import Any

MAX_NAMES = 200  #: in one object; no request has more than twenty


def read_json(text: str | bytes) -> Any:
    """Return the value of a JSON text. Raises ValueError, also for a name that stands twice in an object.

    Which of two equal names counts is for each reader to choose (RFC 8259, Section 4), so that what one part of a
    system checked is not what another one does. Thousands of names would each become a complaint of its own.
    """
    try:
        return json.loads(text, object_pairs_hook=_object)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MAX_NAMES:
        raise ValueError(f"an object has {len(pairs)} names, more than {MAX_NAMES}")
    members = dict(pairs)
    if len(members) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))  # type: ignore[func-returns-value]
        raise ValueError(f"the name {twice[:100]!r} stands twice in one object")
    return members
