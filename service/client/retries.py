"""When a call is tried again, and after how long: what both clients know of it, without doing any of it.

A call is tried again where it may be: GET, HEAD, PUT and DELETE mean the same however often they are sent (RFC 9110,
Section 9.2.2), and every POST carries an `Idempotency-Key` of its own, the same in each attempt. POST of webhooks
takes no key (a secret is not kept for a second answer), and is tried again where it surely did not arrive.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass

import httpx
from tenacity import RetryCallState

from service.client.errors import ClientError, RequestRefused, Unreachable

#: Statuses that pass: too many requests, and a service (or what stands in front of it) that is not up.
PASSING = frozenset({429, 502, 503, 504})
UNTOUCHED = frozenset({429, 503})  #: those of them that are sent before anything is done
NO_CONNECTION = (httpx.ConnectError, httpx.ConnectTimeout)
CONFLICT = 409  #: passes where it names a time: the first request of the same key is still under way
WRONG = (httpx.UnsupportedProtocol, httpx.LocalProtocolError)  #: of the caller's making, and so for good
FIRST_CONTACT_S = 2.0  #: where nobody has answered yet, the address is more likely wrong than the network bad

_chance = secrets.SystemRandom()


@dataclass(frozen=True, kw_only=True, slots=True)
class Retries:
    """How often a call is tried, and for how long. `Retries(attempts=1)` tries once."""

    attempts: int = 10  #: the first among them
    within_s: float = 60.0  #: seconds from the first attempt to the start of the last
    first_pause_s: float = 0.25  #: before the second attempt; it doubles each time
    longest_pause_s: float = 8.0  #: that it grows to; a longer `Retry-After` is waited for

    def pause_s(self, attempt: int, error: BaseException | None = None) -> float:
        """Return the seconds to wait after an attempt (1 is the first): half of it chance, never below `Retry-After`.

        Chance keeps twenty robots, which lost the service in the same instant, from coming back in the same instant.
        """
        longest = min(self.longest_pause_s, self.first_pause_s * 2.0 ** min(attempt - 1, 30))
        pause = longest * _chance.uniform(0.5, 1.0)
        asked = error.retry_after_s if isinstance(error, RequestRefused) else None
        return pause if asked is None else asked + self.first_pause_s * _chance.random()

    def wait(self, state: RetryCallState) -> float:
        """Return the same as `pause_s`, of a call in the hands of tenacity."""
        return self.pause_s(state.attempt_number, error_of(state))

    def stop(self, answered: Callable[[], bool]) -> Callable[[RetryCallState], bool]:
        """Return what says that the next attempt is one too many, or would start too late."""

        def stop(state: RetryCallState) -> bool:
            within_s = self.within_s if answered() else min(self.within_s, FIRST_CONTACT_S)
            elapsed_s = state.seconds_since_start or 0.0
            return state.attempt_number >= self.attempts or elapsed_s + state.upcoming_sleep > within_s

        return stop


def passes(error: BaseException) -> bool:
    """Tell whether the same request may well succeed a little later."""
    if isinstance(error, RequestRefused):
        return error.status in PASSING or (error.status == CONFLICT and error.retry_after_s is not None)
    return isinstance(error, Unreachable) and not isinstance(error.__cause__, WRONG)


def never_arrived(error: BaseException) -> bool:
    """Tell the same of a request that may be carried out once alone: whether it surely was not, and may be later."""
    if isinstance(error, RequestRefused):
        return error.status in UNTOUCHED
    return isinstance(error, Unreachable) and isinstance(error.__cause__, NO_CONNECTION)


def error_of(state: RetryCallState) -> BaseException:
    """Return what an attempt ended in that failed."""
    error = state.outcome.exception() if state.outcome is not None else None
    return error or ClientError("the attempt did not end")


def was_done(error: ClientError, earlier: list[BaseException]) -> bool:
    """Tell whether a deletion is done although it was refused: it is gone, and the answer to an earlier attempt was lost."""
    gone = isinstance(error, RequestRefused) and error.status in (404, 410)
    return gone and any(isinstance(one, Unreachable) for one in earlier)
