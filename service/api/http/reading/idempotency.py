"""The header `Idempotency-Key`: a request that makes something, sent again, is given its first answer again.

Source: draft-ietf-httpapi-idempotency-key-header-07. Routes take `Keyed`, and make what they make under `Keyed.once`.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from json import dumps
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Header, Response
from fastapi import Request as HttpRequest
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from service.api.http.dependencies import Provided
from service.api.http.reading.bodies import Body
from service.catalog.idempotency import ANY_TIMES, Answer, KeyedRequest, Once, OnceByKey, Repeated
from service.catalog.sql.database import Database
from service.catalog.sql.tables import IdempotencyKey
from service.errors import KeyMalformed

NAME = "Idempotency-Key"
REPLAYED = "Idempotent-Replayed"  #: header of an answer that was given before
#: What a request under a key may end in; documented in this order.
KEYED = ("idempotency_key_malformed", "idempotency_key_reused", "idempotency_key_in_use")

#: A string of structured fields (RFC 9651, Section 3.3.3), and the same without quotes, as most clients send it.
_PATTERN = r'^("([ !#-\[\]-~]|\\["\\]){1,255}"|[!#-+\--~]{1,255})$'
_ESCAPED = re.compile(r"\\(.)")

Text = Annotated[
    str | None,
    Header(
        alias=NAME,
        description="chosen by the client, new for each thing that it wants made, and the same when it sends a request "
        "again: a quoted string or one word, at most 255 letters of ASCII, such as a UUID",
        json_schema_extra={"pattern": _PATTERN},
    ),
]


@dataclass(frozen=True, kw_only=True, slots=True)
class KeyOfRequest:
    """The key of a request, or none."""

    key: str | None  #: without quotes
    owner: str
    route: str
    asked: str  #: path and query
    database: Database
    seen: bool  #: whether a request came under this key before, so that it need not be admitted again

    def once(self, body: Body | None, answer: Callable[..., Answer]) -> Once:
        """Return what a thing is made under; `answer` is given the records that are made."""
        if self.key is None:
            return ANY_TIMES
        request = KeyedRequest(
            owner=self.owner, route=self.route, key=self.key, fingerprint=self._fingerprint(body or Body())
        )
        return OnceByKey(self.database, request, answer)

    def _fingerprint(self, body: Body) -> str:
        """Return the SHA-256 of what is asked, not of its bytes: forms have another boundary each time.

        Files count by their digests, which were made as they came.
        """
        files = [[upload.filename, upload.sha256] for upload in body.uploads]
        return hashlib.sha256(dumps([self.asked, body.fields, files], sort_keys=True).encode()).hexdigest()


async def _keyed(request: HttpRequest, services: Provided, text: Text = None) -> KeyOfRequest:
    """Read the key of a request. Raises KeyMalformed."""
    key = None if text is None else read_key(text)
    owner = getattr(request.state, "key", None) or ""
    route = f"{request.method} {request.scope['route'].path}"
    database = services.catalog.database
    return KeyOfRequest(
        key=key,
        owner=owner,
        route=route,
        asked=f"{request.url.path}?{request.url.query}",
        database=database,
        seen=key is not None and await run_in_threadpool(_seen, database, (owner, route, key)),
    )


Keyed = Annotated[KeyOfRequest, Depends(_keyed)]


def read_key(text: str) -> str:
    """Return the key that a header gives, without its quotes. Raises KeyMalformed."""
    if not re.fullmatch(_PATTERN, text):
        raise KeyMalformed(
            f"{NAME} is {text[:80]!r}; send one quoted string, or one word, of 1 to 255 letters of ASCII"
        )
    return _ESCAPED.sub(r"\1", text[1:-1]) if text.startswith('"') else text


def answered(document: BaseModel, *, status: int, headers: dict[str, str]) -> Answer:
    """Return the answer that a document is, as it is kept."""
    body = document.model_dump(mode="json", by_alias=True)
    return Answer(status=status, headers=headers, body=body)


def add_handler(app: FastAPI) -> None:
    """Have `app` give a request that was carried out before its first answer."""
    app.add_exception_handler(Repeated, _repeat)


def _repeat(_request: HttpRequest, error: Exception) -> Response:
    if not isinstance(error, Repeated):
        raise error
    answer = error.answer
    return JSONResponse(answer.body, answer.status, headers={**answer.headers, REPLAYED: "true"})


def _seen(database: Database, at: tuple[str, str, Any]) -> bool:
    with database.read() as session:
        return session.get(IdempotencyKey, at) is not None
