"""Health of the parts: asked in the background, so that an answer about it waits for none of them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from service.errors import ServiceError, is_disk_full

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """A part of the service, and how it is asked for a sign of life."""

    ping: Callable[[], None]  #: returns, or raises whatever is wrong
    every_s: float = 2.0  #: between two questions
    limit_s: float = 3.0  #: after which a part that has not answered has failed
    starts_s: float = 0.0  #: that it may take until it answers first; no failure is logged before


@dataclass(slots=True)
class _Seen:
    """What is known of a part."""

    asked: float | None = None  #: monotonic seconds of the question that waits for its answer
    reason: str | None = "it was not asked yet"  #: why the last answer was none; None: it was one
    logged: str | None = None  #: the failure that the log has
    answered: threading.Event = field(default_factory=threading.Event)


class HealthMonitor:
    """Asks each part in a thread of its own, for a call that hangs cannot be taken back; `failures` never waits."""

    def __init__(self, parts: Mapping[str, Part]) -> None:
        self._parts = dict(parts)
        self._seen = {name: _Seen() for name in parts}
        self._stopped = threading.Event()

    def start(self) -> None:
        """Begin to ask; returns when every part has answered once, or its limit is over."""
        for name in self._parts:
            threading.Thread(target=self._watch, args=(name,), name=f"health-{name}", daemon=True).start()
        for name, part in self._parts.items():
            self._seen[name].answered.wait(part.limit_s)

    def stop(self) -> None:
        """Ask no more."""
        self._stopped.set()

    def failures(self) -> dict[str, str | None]:
        """Return for each part why it does not answer, or None."""
        return {name: self._reason(name) for name in self._parts}

    def _reason(self, name: str) -> str | None:
        seen, asked = self._seen[name], self._seen[name].asked
        waited = 0.0 if asked is None else time.monotonic() - asked
        return f"no answer for {waited:.0f} s" if waited > self._parts[name].limit_s else seen.reason

    def _watch(self, name: str) -> None:
        part, seen = self._parts[name], self._seen[name]
        begun, has_answered = time.monotonic(), False
        while not self._stopped.is_set():
            seen.asked = time.monotonic()
            reason = _asked(part.ping)
            has_answered = has_answered or reason is None
            starts = not has_answered and time.monotonic() - begun < part.starts_s
            if reason is not None and seen.logged != reason and not starts:
                log.warning("the part %s does not answer: %s", name, reason)
                seen.logged = reason
            elif reason is None and seen.logged is not None:
                log.info("the part %s answers again", name)
                seen.logged = None
            seen.reason, seen.asked = reason, None
            seen.answered.set()
            self._stopped.wait(part.every_s)


def _asked(ping: Callable[[], None]) -> str | None:
    """Return why a part does not answer: the sentence of our own errors, else the kind, for it may hold an address."""
    try:
        ping()
    except Exception as error:  # whatever it is, this part does not answer
        if is_disk_full(error):
            return "its disk is full"
        return str(error) if isinstance(error, ServiceError) else type(error).__name__
    return None
