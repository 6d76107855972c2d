"""Requests under an `Idempotency-Key`: what each was answered, so that one sent again makes nothing a second time.

The key is claimed in the transaction that makes the thing, and its answer kept with it: whoever is killed leaves both or
neither. What is made and then taken back (the queue did not answer) is told from the rest by `under_way`, which ends
when the request does. Source: draft-ietf-httpapi-idempotency-key-header-07.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import delete
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.catalog.sql.database import Database
from service.catalog.sql.tables import IdempotencyKey, Job, now
from service.errors import KeyInUse, KeyReused

#: After which a request that is still under way was cut off; it has made its thing and waits for the queue alone.
UNDER_WAY = timedelta(seconds=30)


@dataclass(frozen=True, kw_only=True, slots=True)
class Answer:
    """What a request was answered."""

    status: int
    headers: dict[str, str] = field(default_factory=dict)
    body: Any = None  #: plain JSON


class Repeated(Exception):
    """A request under this key was carried out before; `answer` is what it was answered."""

    def __init__(self, answer: Answer) -> None:
        super().__init__("the request was carried out before")
        self.answer = answer


@dataclass(frozen=True, kw_only=True, slots=True)
class KeyedRequest:
    """A request as it is told from others."""

    owner: str  #: id of the API key that it came with; empty: none
    route: str  #: method and template of the path
    key: str  #: as the client chose it
    fingerprint: str  #: SHA-256 of what it asks, hexadecimal


class Once:
    """A request that makes something. This one has no key, so that it may be made again; see `OnceByKey`."""

    def look(self) -> None:
        """Raise Repeated where it was carried out, KeyInUse where it is, KeyReused where it asked something else."""

    def claim(self, session: Session) -> None:
        """Claim the key in the transaction that makes the thing, before all else of it. Raises as `look` does."""

    def keep(self, session: Session, *made: Any, job: Job | None = None) -> None:
        """Keep the answer that tells of the records `made`, in the same transaction; it is final where `job` is None."""

    def note(self, *made: Any) -> None:
        """Keep the answer in a transaction of its own, for what is the same thing when it is made again."""

    def settle(self) -> None:
        """Note that what was made stays."""

    def drop(self) -> None:
        """Note that what was made was taken back: the request may come again."""


ANY_TIMES = Once()


class OnceByKey(Once):
    """A request under a key, carried out at most once."""

    def __init__(self, database: Database, request: KeyedRequest, answer: Callable[..., Answer]) -> None:
        """`answer` is given the records that are made."""
        self._database, self._request, self._answer = database, request, answer
        self._at = (request.owner, request.route, request.key)

    def look(self) -> None:
        with self._database.read() as session:
            row = session.get(IdempotencyKey, self._at)
        if row is not None and not self._is_cut_off(row):
            self._refuse(row)
        if row is not None:
            self._recover()

    def claim(self, session: Session) -> None:
        values = {
            "owner": self._request.owner,
            "route": self._request.route,
            "key": self._request.key,
            "fingerprint": self._request.fingerprint,
            "created": now(),
        }
        insert = postgresql.insert if _is_postgresql(session) else sqlite.insert
        statement = insert(IdempotencyKey).values(values).on_conflict_do_nothing()
        if session.execute(statement.returning(IdempotencyKey.key)).first() is None:
            row = session.get(IdempotencyKey, self._at)
            if row is None:  # it was taken back just now
                raise KeyInUse(
                    f"the request under the Idempotency-Key {self._request.key!r} is being carried out"
                )
            self._refuse(row)

    def keep(self, session: Session, *made: Any, job: Job | None = None) -> None:
        answer, row = self._answer(*made), session.get_one(IdempotencyKey, self._at)
        row.status, row.headers, row.body = answer.status, answer.headers, answer.body
        if job is not None:
            row.job_id, row.under_way = job.job_id, now()

    def note(self, *made: Any) -> None:
        with self._database.write() as session:
            self.claim(session)
            self.keep(session, *made)

    def settle(self) -> None:
        with self._database.write() as session:
            row = session.get(IdempotencyKey, self._at)
            if row is not None:
                row.under_way = None

    def drop(self) -> None:
        with self._database.write() as session:
            row = session.get(IdempotencyKey, self._at)
            if row is not None:
                session.delete(row)

    def _refuse(self, row: IdempotencyKey) -> None:
        """Raise what a request under a key that is taken ends in."""
        if row.fingerprint != self._request.fingerprint:
            raise KeyReused(
                f"the Idempotency-Key {self._request.key!r} came with another request before; take a new one for each"
            )
        if row.under_way is not None:
            raise KeyInUse(
                f"the request under the Idempotency-Key {self._request.key!r} is being carried out"
            )
        raise Repeated(Answer(status=row.status or 200, headers=row.headers or {}, body=row.body))

    def _is_cut_off(self, row: IdempotencyKey) -> bool:
        same = row.fingerprint == self._request.fingerprint
        return same and row.under_way is not None and row.under_way < now() - UNDER_WAY

    def _recover(self) -> None:
        """Finish for a process that was killed: what it made stays (the dispatcher sees to the job), or is gone."""
        with self._database.write() as session:
            row = session.get(IdempotencyKey, self._at, with_for_update=True)
            if row is None:
                return
            if session.get(Job, row.job_id) is None:
                session.delete(row)
                return
            row.under_way = None
        self.look()


def forget(session: Session, before: datetime) -> None:
    """Let go of the keys that came before an instant."""
    session.execute(delete(IdempotencyKey).where(IdempotencyKey.created < before))


def _is_postgresql(session: Session) -> bool:
    return session.get_bind().dialect.name == "postgresql"
