"""Time limits of a connection to PostgreSQL: what the server is asked to keep, and what the client keeps by itself.

A server that hangs keeps no limit. Its machine goes on acknowledging packets, so TCP notices nothing either: the client
has to look at the clock while it waits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from service.catalog.patience import Patience

if TYPE_CHECKING:
    import psycopg

_LOOK_S = 0.1  #: psycopg's own: how often a wait looks up for a signal


def limits(patience: Patience) -> dict[str, Any]:
    """Return the parameters of a connection (libpq, Section 34.1.2) that waits no longer than `patience`.

    A machine that is gone is noticed after about 15 s: keepalives where we wait, `tcp_user_timeout` where we sent.
    """
    settings = {
        "statement_timeout": round(patience.statement_s * 1000),
        "lock_timeout": round(patience.lock_s * 1000),
        "idle_in_transaction_session_timeout": round(patience.statement_s * 2000),
    }
    return {
        "connect_timeout": math.ceil(patience.connect_s),
        "options": " ".join(f"-c {name}={value}" for name, value in settings.items()),
        "keepalives_idle": 5,
        "keepalives_interval": 3,
        "keepalives_count": 3,
        "tcp_user_timeout": 15_000,
    }


def connecting(limit_s: float) -> Callable[..., psycopg.Connection[Any]]:
    """Return a `do_connect` handler of SQLAlchemy whose connections wait at most `limit_s` for any one answer.

    psycopg is imported by the dialect before; SQLite alone does without it.
    """
    import psycopg  # noqa: PLC0415

    class LimitedConnection(psycopg.Connection[Any]):
        """Closes itself when the server takes too long: an answer that comes later would be taken for another's."""

        def wait(self, gen: Any, interval: float = _LOOK_S, timeout: float | None = None) -> Any:
            try:
                return super().wait(gen, interval, timeout or limit_s)
            except psycopg.errors._WaitTimeout as error:
                self.close()
                raise NoAnswer(f"no answer within {limit_s:g} s") from error

    class NoAnswer(psycopg.OperationalError):
        """The server took a statement and said nothing more."""

    def connect(_dialect: Any, _record: Any, arguments: Any, parameters: Any) -> psycopg.Connection[Any]:
        return LimitedConnection.connect(*arguments, **parameters)

    return connect
