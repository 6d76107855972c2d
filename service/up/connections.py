"""Limits on connections: a client that sends nothing, or next to nothing, does not hold one for ever.

uvicorn bounds the pause between two requests alone. This is its protocol on h11 with a clock for each state of a
connection (as mod_reqtimeout has them for Apache, `client_header_timeout` and `reset_timedout_connection` for nginx):

| state | limit |
| --- | --- |
| waiting for a request's header | `header_s` in all, however slowly it comes, and `header_bytes` |
| receiving a body | `body_bytes` in each `body_window_s`: a robot with bad Wi-Fi passes, a byte a second does not |
| answered, and the client still sends | `linger_s` |
| sending an answer that nobody reads | `write_s` until the buffer has room again |
| closing | `close_s`, then what was not sent is dropped |

There are `connections` of them at most. One more closes the one of which least is lost, and its clock would end first:
one that waits for a header or for another request, or that was answered and still sends, as who has no key is. Where
there is none it is answered 503.

What never becomes a request, for it is no sound HTTP or ends too early, is answered by a problem document as well.
"""

from __future__ import annotations

import asyncio
import logging
import re
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.api.http.answering import problems
from service.api.http.guards import security_headers
from service.settings import Settings

log = logging.getLogger("spicd")
_END_OF_HEADER = re.compile(rb"\n\r?\n")
_WARN_EVERY_S = 60.0
_warned = [-_WARN_EVERY_S]  #: when the log was told last, monotonic seconds


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """How long each state may last, in seconds, and how many connections there may be."""

    connections: int = 400
    header_s: float = 45.0  #: bad Wi-Fi pauses for half a minute; at the cap a silent one goes at once
    header_bytes: int = 16 * 1024
    body_window_s: float = 60.0
    body_bytes: int = (
        32 * 1024
    )  #: in each window: half a kilobyte a second, and a minute of silence now and then
    linger_s: float = 10.0
    write_s: float = 60.0
    close_s: float = 5.0


class LimitedProtocol(H11Protocol):
    """One connection, with its clocks."""

    limits: ClassVar[Limits] = Limits()

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._state = ""  #: whose clock runs; empty: none
        self._clock: asyncio.TimerHandle | None = None
        self._write_clock: asyncio.TimerHandle | None = None
        self._window_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clock of the first header, and make room for the connection."""
        super().connection_made(transport)
        if (own := transport.get_extra_info("socket")) is not None:
            own.setsockopt(
                socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1
            )  # a robot that left its Wi-Fi says no goodbye
        self._wait_for_header()
        if len(self.connections) > self.limits.connections:
            self._make_room()

    def data_received(self, data: bytes) -> None:
        """Take what came, and look which clock has to run now."""
        self._window_bytes += len(data)
        if self.conn.their_state is h11.IDLE and self._is_too_long(data):
            most = self.limits.header_bytes
            self._refuse("header_too_large", f"the head of the request has more than {most} bytes")
            return
        super().data_received(data)
        self._look(received=True)

    def eof_received(self) -> None:
        """Tell a client that ends within its body, and still listens, that nothing was kept; then close."""
        if self.conn.their_state is h11.SEND_BODY and not self.cycle.response_started:
            self._refuse("incomplete_body", "the connection ended within the body; nothing was kept")

    def send_400_response(self, msg: str) -> None:
        """Answer what h11 refuses; called where its error is handled."""
        error = sys.exception()
        detail = str(error) if isinstance(error, h11.RemoteProtocolError) else msg
        too_large = getattr(error, "error_status_hint", 400) == 431
        self._refuse("header_too_large" if too_large else "broken_request", detail)

    def on_response_complete(self) -> None:
        """Note that a request was answered, whether or not all of it was read."""
        super().on_response_complete()
        self._look()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clocks."""
        self._stop()
        self.resume_writing()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Start the clock of a client that does not read."""
        super().pause_writing()
        self._write_clock = self._write_clock or self.loop.call_later(self.limits.write_s, self._abort)

    def resume_writing(self) -> None:
        """Stop it."""
        super().resume_writing()
        if self._write_clock is not None:
            self._write_clock.cancel()
            self._write_clock = None

    def timeout_keep_alive_handler(self) -> None:
        """Close a connection that was idle between two requests, for good."""
        super().timeout_keep_alive_handler()
        self.loop.call_later(self.limits.close_s, self._abort)

    def _look(self, *, received: bool = False) -> None:
        """Run the clock of the connection's state; until the next request begins that of uvicorn runs."""
        if self.transport.is_closing():
            self._stop()
        elif self.conn.their_state is h11.SEND_BODY:
            if self.cycle.response_complete:
                self._run("linger", self.limits.linger_s, self._close)
            elif self._state != "body":
                self._window_bytes = 0
                self._run("body", self.limits.body_window_s, self._look_at_body)
        elif self.conn.their_state is h11.IDLE and (received or self._state == "header"):
            self._wait_for_header()  # an empty line alone begins a request as well
        else:
            self._stop()  # the request is here, and it is for the app to answer; or it was answered

    def _is_too_long(self, data: bytes) -> bool:
        """Tell whether a header goes on behind `header_bytes`; h11 looks only where it has not ended yet."""
        begun = self.conn.trailing_data[0] + data[: self.limits.header_bytes]
        longest = self.limits.header_bytes
        return len(begun) >= longest and _END_OF_HEADER.search(begun, 0, longest) is None

    def _wait_for_header(self) -> None:
        self._run("header", self.limits.header_s, self._refuse_slow)

    def _look_at_body(self) -> None:
        """Go on where enough of the body came, or it was us who did not read; else end it."""
        if self._window_bytes < self.limits.body_bytes and not self.flow.read_paused:
            self._refuse_slow()
            return
        self._window_bytes, self._state = 0, ""
        self._run("body", self.limits.body_window_s, self._look_at_body)

    def _run(self, state: str, seconds: float, end: Callable[[], None]) -> None:
        """Run the clock of a state, unless it runs already."""
        if self._state != state:
            self._stop()
            self._state, self._clock = state, self.loop.call_later(seconds, end)

    def _stop(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
        self._state, self._clock = "", None

    def _refuse_slow(self) -> None:
        what = "head" if self._state == "header" else "body"
        self._refuse("too_slow", f"the {what} of the request came too slowly; send it again")

    def _refuse(self, code: str, detail: str, *, retry_after_s: int | None = None) -> None:
        """Answer with a problem, where nothing was answered yet, and close."""
        begun = self._window_bytes > 0 or self._state != "header"
        answering = self.cycle is not None and self.cycle.response_started
        answered = (
            answering and self.conn.our_state is not h11.IDLE
        )  # where it is, the next request has begun
        if begun and not self.transport.is_closing() and not answered:
            self.transport.write(raw_problem(code, detail, retry_after_s=retry_after_s))
        self._close()

    def _close(self) -> None:
        log.debug("closing a connection of %s in the state %r", self.client and self.client[0], self._state)
        self._stop()
        self.transport.close()
        self.loop.call_later(self.limits.close_s, self._abort)

    def _abort(self) -> None:
        self.transport.abort()

    def _make_room(self) -> None:
        """Close the connection of which least is lost and that would end first; where there is none, this one."""
        _warn_of_crowd(self.limits.connections)
        others = [one for one in self.connections if isinstance(one, LimitedProtocol) and one is not self]
        waiting = [(due, one) for one in others if (due := one._waits_until()) is not None]
        if waiting:
            min(waiting, key=lambda entry: entry[0])[1]._close()
        else:
            self._state = "no room"
            most = self.limits.connections
            self._refuse(
                "unavailable", f"{most} connections are at work, as many as may be", retry_after_s=10
            )

    def _waits_until(self) -> float | None:
        """Return when a connection ends by its clock on which nothing is going on; None where something is."""
        clock = self._clock if self._state in ("header", "linger") else self.timeout_keep_alive_task
        return None if clock is None or self.transport.is_closing() else clock.when()


def raw_problem(code: str, detail: str, *, retry_after_s: int | None = None) -> bytes:
    """Return a problem document as a whole answer (RFC 9112), for a request that never reached the app."""
    answer = problems.response(code, detail)
    answer.headers.update({**security_headers.HEADERS, "Cache-Control": "no-store", "Connection": "close"})
    if retry_after_s is not None:
        answer.headers["Retry-After"] = str(retry_after_s)
    reason = HTTPStatus(answer.status_code).phrase
    lines = [
        f"HTTP/1.1 {answer.status_code} {reason}",
        *(f"{name.title()}: {value}" for name, value in answer.headers.items()),
    ]
    return "\r\n".join([*lines, "", ""]).encode("latin-1") + bytes(answer.body)


def _warn_of_crowd(connections: int) -> None:
    """Tell the log that there are as many connections as may be, once a minute."""
    if time.monotonic() - _warned[0] > _WARN_EVERY_S:
        _warned[0] = time.monotonic()
        log.warning("%d connections are open, as many as may be (SPICD_MAX_CONNECTIONS)", connections)


def limits_of(settings: Settings) -> Limits:
    """Return the limits that the settings name; the others are for no operator to know."""
    return Limits(connections=settings.max_connections)


def limited_protocol(limits: Limits) -> type[LimitedProtocol]:
    """Return the protocol under these limits, as `uvicorn.Config(http=...)` takes it."""
    return type("LimitedProtocol", (LimitedProtocol,), {"limits": limits})
