"""API keys: a secret that a client has, and here its digest with what it may do.

A secret has 256 random bits, so a plain SHA-256 keeps it: there is no dictionary to try (unlike for passwords). It
begins with `spicd_`, by which scanners of repositories and logs find one that leaked.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import secrets
from collections.abc import Collection, Iterator, Sequence
from datetime import datetime
from typing import get_args

from sqlalchemy import ColumnElement, or_, select
from sqlalchemy.exc import IntegrityError

from service.catalog.records import KeyRecord, Scope
from service.catalog.sql.database import Database
from service.catalog.sql.tables import Key, new_id, now
from service.errors import BadRequest, Conflict, NotFound
from service.settings import Settings

PREFIX = "spicd_"
SCOPES: tuple[Scope, ...] = get_args(Scope)
_BYTES = 32
#: As `new_secret` makes one, or 32 bytes in hexadecimal, or more of either.
_SECRET = re.compile(re.escape(PREFIX) + r"[A-Za-z0-9_-]{43,200}")
_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


@contextlib.contextmanager
def open_keys(settings: Settings) -> Iterator[Keys]:
    """Open the keys of the catalog that `settings` name, and nothing else of it; the tables are brought up to date."""
    if settings.database_url is None:
        settings.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    with contextlib.closing(Database(settings.resolved_database_url())) as database:
        database.upgrade()
        yield Keys(database)


class Keys:
    """The keys of the catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(
        self,
        name: str,
        *,
        scopes: Sequence[str],
        maps: Collection[str] | None = None,
        expires: datetime | None = None,
        secret: str | None = None,
    ) -> tuple[KeyRecord, str]:
        """Record a key, and return it with its secret, which nobody can look up later.

        A `secret` that was made elsewhere is taken as it is; one that is here already, and valid, gives its key unchanged.
        Raises BadRequest, and Conflict for a secret that was revoked.
        """
        secret = new_secret() if secret is None else secret
        _check(name, scopes, maps, expires, secret)
        row = Key(
            key_id=new_id("key"),
            name=name,
            digest=digest_of(secret),
            scopes=[scope for scope in SCOPES if scope in scopes],
            maps=None if maps is None else sorted(maps),
            created=now(),
            expires=expires,
            revoked=None,
        )
        try:
            with self._database.write() as session:
                session.add(row)
                session.flush()
                return KeyRecord.of_row(row), secret
        except IntegrityError:
            known = self.find(secret)
        if known is None:
            raise Conflict("this secret was revoked, or has expired; make another")
        return known, secret

    def find(self, secret: str) -> KeyRecord | None:
        """Return the key of a secret; None where it is not known, was revoked or has expired."""
        if not _SECRET.fullmatch(
            secret
        ):  # none of ours: no look at the database, which a stranger could repeat
            return None
        query = select(Key).where(Key.digest == digest_of(secret), *_valid())
        with self._database.read() as session:
            row = session.scalar(query)
            return None if row is None else KeyRecord.of_row(row)

    def all(self) -> tuple[KeyRecord, ...]:
        """Return every key, newest first, those that were revoked as well."""
        with self._database.read() as session:
            rows = session.scalars(select(Key).order_by(Key.created.desc(), Key.key_id))
            return tuple(KeyRecord.of_row(row) for row in rows)

    def any_valid(self) -> bool:
        """Tell whether anybody has a key that is taken."""
        with self._database.read() as session:
            return session.scalar(select(Key.key_id).where(*_valid()).limit(1)) is not None

    def revoke(self, key_id: str) -> KeyRecord:
        """Have a key taken no more, from now on; once more changes nothing. Raises NotFound."""
        with self._database.write() as session:
            row = session.get(Key, key_id)
            if row is None:
                raise NotFound(f"no key {key_id!r}; `spicd keys list` lists those there are")
            row.revoked = row.revoked or now()
            return KeyRecord.of_row(row)


def new_secret() -> str:
    """Return a fresh secret."""
    return PREFIX + secrets.token_urlsafe(_BYTES)


def digest_of(secret: str) -> str:
    """Return what is kept of a secret: its SHA-256, hexadecimal."""
    return hashlib.sha256(secret.encode("ascii")).hexdigest()


def _valid() -> tuple[ColumnElement[bool], ...]:
    return Key.revoked.is_(None), or_(Key.expires.is_(None), Key.expires > now())


def _check(
    name: str,
    scopes: Sequence[str],
    maps: Collection[str] | None,
    expires: datetime | None,
    secret: str,
) -> None:
    """Raise BadRequest for what makes no key. No sentence holds the secret."""
    if not name.strip() or len(name) > 200 or not name.isprintable():
        raise BadRequest("a key has a name of one line, by which people know whose it is")
    if unknown := [scope for scope in scopes if scope not in SCOPES]:
        raise BadRequest(f"no scope {unknown[0]!r}; there is {', '.join(SCOPES)}")
    if not scopes:
        raise BadRequest(f"a key has at least one scope: {', '.join(SCOPES)}")
    if maps is not None and not maps:
        raise BadRequest("a key is bound to one map at least, or to none in particular")
    if wrong := [map_id for map_id in maps or () if not _ID.fullmatch(map_id)]:
        raise BadRequest(f"{wrong[0]!r} cannot be the id of a map")
    if maps is not None and "admin" in scopes:
        raise BadRequest("a key with the scope admin may do everything; it cannot be bound to maps")
    if expires is not None and expires <= now():
        raise BadRequest(f"the key would have expired at {expires.isoformat()}")
    if not _SECRET.fullmatch(secret):
        raise BadRequest(
            f"a secret is {PREFIX} and 43 to 200 letters, digits, - or _ of at least 256 random bits, "
            f"such as {PREFIX}$(openssl rand -hex 32)"
        )
