"""What goes into a request: the key, the query, the quoted id, and a file that may be sent more than once."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import httpx

from service.client.errors import ClientError, Document

DEFAULT_URL = "http://127.0.0.1:8000"
PIECE = 1 << 20  #: bytes sent at a time

Pose = Sequence[Sequence[float]]  #: (4, 4) row-major, map_from_sensor
OnSent = Callable[
    [int, int], None
]  #: bytes sent, bytes in all; it starts anew where the upload is tried again
OnReceived = Callable[[int, int | None], None]  #: bytes received, bytes in all where the service says so


def authorization(key: str | None) -> dict[str, str]:
    """Return the header that carries an API key. Raises ClientError for what cannot be one.

    The key is `key`; None: that of the environment (SPICD_KEY), "": none.
    """
    secret = (os.environ.get("SPICD_KEY", "") if key is None else key).strip()
    if not secret.isascii() or not secret.isprintable():
        raise ClientError("the API key has letters that no key has; look at SPICD_KEY")
    return {"Authorization": f"Bearer {secret}"} if secret else {}


def given(**values: Any) -> dict[str, Any]:
    """Return what was given, without what was left out."""
    return {name: value for name, value in values.items() if value is not None}


def keyed(idempotency_key: str | None) -> dict[str, str]:
    """Return the header of a key that the caller keeps; without one each call has its own."""
    return given(**{"Idempotency-Key": idempotency_key})


def scans_of(scan_ids: Sequence[str], poses: Mapping[str, Pose] | None) -> dict[str, Any]:
    """Return the members of a request that name its scans, in their order, those of `poses` with a pose of their own.

    Raises ClientError for the pose of a scan that is not among them.
    """
    if not poses:
        return {"scan_ids": list(scan_ids)}
    strangers = sorted(set(poses) - set(scan_ids))
    if strangers:
        raise ClientError(f"{', '.join(strangers)}: poses of scans that are not named")
    matrices = {scan_id: [list(row) for row in pose] for scan_id, pose in poses.items()}
    return {"scans": [given(scan_id=scan_id, pose=matrices.get(scan_id)) for scan_id in scan_ids]}


def quoted(name: str) -> str:
    """Quote an id as one segment of a path, whatever was typed."""
    return quote(name, safe="")


class Body:
    """A file or bytes as the content of a request, read from its start for each attempt."""

    def __init__(self, source: Path | bytes, on_sent: OnSent | None = None) -> None:
        """Raises OSError where the file is not there."""
        self._source = source
        self._on_sent = on_sent
        self.size = source.stat().st_size if isinstance(source, Path) else len(source)  #: bytes

    def __iter__(self) -> Iterator[bytes]:
        if isinstance(self._source, bytes):
            yield self._source
            return
        sent = 0
        with self._source.open("rb") as file:
            while piece := file.read(PIECE):
                yield piece
                sent += len(piece)
                if self._on_sent is not None:
                    self._on_sent(sent, self.size)


class AsyncBody:
    """The same for an event loop; it is read in a thread."""

    def __init__(self, source: Path | bytes, on_sent: OnSent | None = None) -> None:
        """Raises OSError where the file is not there."""
        self._body = Body(source, on_sent)
        self.size = self._body.size  #: bytes

    async def __aiter__(self) -> AsyncIterator[bytes]:
        pieces = iter(self._body)
        while piece := await anyio.to_thread.run_sync(next, pieces, b""):
            yield piece


def going_on(received: int, tag: str | None) -> dict[str, str]:
    """Return the headers that ask for a file, from byte `received` on where it still has this entity tag.

    Bytes are counted as they lie in the file, so that they may not be compressed on the way (RFC 9110, Section 14.2).
    """
    plain = {"Accept-Encoding": "identity"}
    return plain if not received or tag is None else {**plain, "Range": f"bytes={received}-", "If-Range": tag}


def strong_tag(answer: httpx.Response) -> str | None:
    """Return the entity tag of an answer; None for a weak one, which a range may not rest on (RFC 9110, 13.1.5)."""
    tag: str | None = answer.headers.get("ETag")
    return None if tag is None or tag.startswith("W/") else tag


def length_in_all(answer: httpx.Response, start: int) -> int | None:
    """Return the bytes of a file of which `answer` brings those from `start` on; None where it does not say."""
    length = answer.headers.get("Content-Length", "")
    return start + int(length) if length.isdigit() else None


def csv_lines(answer: httpx.Response) -> list[str]:
    """Return the lines of a page of CSV without their ends, the names of the columns first. Raises ClientError where it is none.

    A value may hold a line break, and its record then takes two lines, in the order they came.
    """
    if answer.headers.get("Content-Type", "").partition(";")[0].strip() != "text/csv":
        raise ClientError(
            f"{answer.request.url} does not answer with CSV; the service is older than this client"
        )
    return answer.text.splitlines()


def next_href(page: Document) -> str | None:
    """Return where the page after this one is (RFC 8288); None behind the last."""
    return next((link["href"] for link in page.get("links", ()) if link.get("rel") == "next"), None)
