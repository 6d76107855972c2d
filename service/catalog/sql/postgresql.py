"""Time limits of a connection to PostgreSQL: what the server is asked to keep, and what the client keeps by itself.

A server that hangs keeps no limit. Its machine goes on acknowledging packets, so TCP notices nothing either: the client
has to look at the clock while it waits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, event

from service.catalog.sql.patience import Patience

if TYPE_CHECKING:
    import psycopg

_LOOK_S = 0.1  #: psycopg's own: how often a wait looks up for a signal
_MARGIN_S = 2.0  #: by which a client outwaits the limit that it gave the server


def parameters(patience: Patience) -> dict[str, Any]:
    """Return the parameters of a connection (libpq, Section 34.1.2) that waits no longer than `patience`.

    A machine that is gone is noticed after about 15 s: keepalives where we wait, `tcp_user_timeout` where we sent.
    """
    settings = {
        "statement_timeout": _ms(patience.statement_s),
        "lock_timeout": _ms(patience.lock_s),
        "idle_in_transaction_session_timeout": _ms(2 * patience.write_s),
    }
    return {
        "connect_timeout": math.ceil(patience.connect_s),
        "options": " ".join(f"-c {name}={value}" for name, value in settings.items()),
        "keepalives_idle": 5,
        "keepalives_interval": 3,
        "keepalives_count": 3,
        "tcp_user_timeout": 15_000,
    }


def limit(engine: Engine, patience: Patience) -> None:
    """Have every connection of an engine close itself when the server takes longer than `patience` to answer.

    A transaction with the option `spicd_write` has `write_s` for a statement, one without `statement_s`.
    """
    reading, writing = patience.statement_s + _MARGIN_S, patience.write_s + _MARGIN_S

    def begin(connection: Connection) -> None:
        if connection.get_execution_options().get("spicd_write", False):
            _driver(connection).limit_s = writing
            connection.exec_driver_sql(f"SET LOCAL statement_timeout = {_ms(patience.write_s)}")

    def check_in(connection: Any, _record: Any) -> None:
        if connection is not None:
            connection.limit_s = reading

    event.listen(engine, "do_connect", _connecting(reading))
    event.listen(engine, "begin", begin)
    event.listen(engine, "checkin", check_in)


def _connecting(limit_s: float) -> Callable[..., psycopg.Connection[Any]]:
    """Return what makes a connection for SQLAlchemy, which has imported psycopg by then; SQLite does without it."""
    import psycopg  # noqa: PLC0415

    class NoAnswer(psycopg.OperationalError):
        """The server took a statement and said nothing more."""

    class LimitedConnection(psycopg.Connection[Any]):
        """Closes itself when the server takes too long: an answer that comes later would be taken for another's."""

        def wait(self, gen: Any, interval: float = _LOOK_S, timeout: float | None = None) -> Any:
            waits = getattr(self, "limit_s", limit_s)
            try:
                return super().wait(gen, interval, timeout or waits)
            except psycopg.errors._WaitTimeout as error:
                self.close()
                raise NoAnswer(f"no answer within {waits:g} s") from error

    def connect(_dialect: Any, _record: Any, arguments: Any, options: Any) -> psycopg.Connection[Any]:
        return LimitedConnection.connect(*arguments, **options)

    return connect


def _driver(connection: Connection) -> Any:
    return connection.connection.dbapi_connection


def _ms(seconds: float) -> int:
    return round(seconds * 1000)
