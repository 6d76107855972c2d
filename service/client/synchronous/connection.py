# Made of asynchronous/connection.py by `make client`: change that one.
"""How a request reaches the service: tried again where it may be, page after page, and streamed into a file."""

from __future__ import annotations

import time
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self, TypeVar, cast
from uuid import uuid4

import httpx
from tenacity import Retrying, retry_if_exception

from service.client.downloads import Part
from service.client.errors import ClientError, Document, RequestRefused, refused, unreachable
from service.client.requests import (
    DEFAULT_URL,
    OnReceived,
    authorization,
    going_on,
    length_in_all,
    next_href,
    strong_tag,
)
from service.client.retries import Retries, error_of, never_arrived, passes, was_done

T = TypeVar("T")


class Connection:
    """A context manager over httpx's client. Every method raises `ClientError`."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        key: str | None = None,
        transport: httpx.BaseTransport | None = None,
        retries: Retries | None = None,
        timeout_s: float = 60.0,
    ) -> None:
        """Take the secret of an API key as `key`; None: that of the environment (SPICD_KEY), "": none.

        `timeout_s` is how long the service may be silent in the midst of an answer, in seconds.
        """
        self.url = url.rstrip("/")
        self.retries = retries or Retries()
        self._answered = False
        self._http = httpx.Client(
            base_url=self.url,
            timeout=httpx.Timeout(timeout_s, connect=min(timeout_s, 5.0)),
            transport=transport,
            headers=authorization(key),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

    # one request

    def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Return a successful answer; tried again as `retries` says.

        `stream`: its body is still to be read; `earlier`: a list that takes what went wrong in the attempts before;
        `keyed`: False for a POST that takes no key, and is sent again only where it surely did not arrive.
        """
        keyed = request.pop("keyed", True)
        if method == "POST" and keyed:
            request["headers"] = {"Idempotency-Key": str(uuid4()), **request.get("headers", {})}
        errors: list[BaseException] = request.pop("earlier", [])
        retrying = Retrying(
            retry=retry_if_exception(passes if keyed else never_arrived),
            wait=self.retries.wait,
            stop=self.retries.stop(lambda: self._answered),
            before_sleep=lambda state: errors.append(error_of(state)),
            sleep=time.sleep,
            reraise=True,
        )
        answer: httpx.Response = retrying(self._attempt, method, path, **request)
        return answer

    def _attempt(self, method: str, path: str, *, stream: bool = False, **request: Any) -> httpx.Response:
        try:
            answer = self._http.send(self._http.build_request(method, path, **request), stream=stream)
            self._answered = True
            if not answer.is_success:
                answer.read()
        except httpx.TransportError as error:
            raise unreachable(self.url, error) from error
        if not answer.is_success:
            raise refused(answer)
        return answer

    def _json(self, kind: type[T], method: str, path: str, **request: Any) -> T:
        """Return the JSON object of an answer, which is a document of this kind."""
        return self._document(kind, self._send(method, path, **request))

    def _all(self, kind: type[T], path: str, name: str) -> list[T]:  # noqa: ARG002  # for the type checker
        """Return the list `name` of a document and of the pages that follow it, each item a document of this kind."""
        items: list[T] = []
        following: str | None = path
        while following:
            answer = self._send("GET", following)
            page = self._document(dict[str, Any], answer)
            items += page[name]
            following = self._joined(answer.request.url, next_href(page))
        return items

    def _delete(self, path: str) -> None:
        """Have a thing deleted; one that is gone after an attempt whose answer was lost is deleted."""
        earlier: list[BaseException] = []
        try:
            self._send("DELETE", path, earlier=earlier)
        except RequestRefused as refusal:
            if not was_done(refusal, earlier):
                raise

    def _document(self, kind: type[T], answer: httpx.Response) -> T:
        try:
            document = answer.json()
        except ValueError:
            document = None
        if not isinstance(document, dict):
            where = answer.request.url
            raise ClientError(
                f"{where} did not answer with a JSON object ({kind.__name__}); is this the service?"
            )
        return cast(T, document)

    def next_page(self, page: T) -> T | None:
        """Return the page after one that a method gave; None behind the last."""
        following = self._joined(httpx.URL(self.url), next_href(cast(Document, page)))
        return None if following is None else self._json(cast(type[T], dict), "GET", following)

    def _joined(self, asked: httpx.URL, href: str | None) -> str | None:
        """Return the address of a link. Raises ClientError where it is of another service: the key is not for that."""
        if href is None:
            return None
        following = asked.join(href)
        if (following.scheme, following.host, following.port) != (asked.scheme, asked.host, asked.port):
            raise ClientError(f"{asked} goes on at {following}, which is another service")
        return str(following)

    # files

    def download(
        self, path: str, to: Path, on_received: OnReceived | None = None, *, resume: bool = False
    ) -> Path:
        """Write an answer such as `/surveys/{id}/cloud.ply` to a file, streamed; nothing is left when it fails.

        A connection that breaks is taken up where it broke (RFC 9110, Section 14), if the file is still the same one.
        With `resume` what came is left beside it (`.part`) when the connection does not come back or the process is
        killed, and a later call goes on there.
        """
        part = Part(to, kept=resume)
        with part.opened() as file:
            self._receive(path, file, part, on_received)
        return to

    def _receive(self, path: str, file: BinaryIO, part: Part, on_received: OnReceived | None) -> None:
        """Write the rest of an answer behind its part. Raises `Unreachable` after too many breaks without a byte."""
        fruitless = 0
        while True:
            answer = self._rest(path, file, part)
            start = file.tell() if answer.status_code == httpx.codes.PARTIAL_CONTENT else 0
            file.seek(start)
            file.truncate()
            part.of(strong_tag(answer))
            try:
                for piece in answer.iter_bytes():
                    file.write(piece)
                    if on_received is not None:
                        on_received(file.tell(), length_in_all(answer, start))
                return
            except httpx.TransportError as error:
                fruitless = fruitless + 1 if file.tell() == start else 1
                if fruitless >= self.retries.attempts:
                    raise unreachable(self.url, error) from error
                time.sleep(self.retries.pause_s(fruitless))
            finally:
                answer.close()

    def _rest(self, path: str, file: BinaryIO, part: Part) -> httpx.Response:
        """Ask for what is missing of a file; for all of it where the part has as much as the file, or more."""
        try:
            return self._send("GET", path, stream=True, headers=going_on(file.tell(), part.tag))
        except RequestRefused as refusal:
            if refusal.status != httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE:
                raise
            return self._send("GET", path, stream=True, headers=going_on(0, None))
