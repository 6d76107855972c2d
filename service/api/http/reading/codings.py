"""Content codings: gzip (RFC 9110, Section 8.4.1.3), in bodies of requests and in answers.

A body is decoded in pieces of bounded size, so that one that unpacks to a thousand times its length costs no more
memory than another, and is ended where it grows over the limit of the request.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from typing import Protocol

from starlette.datastructures import Headers

from service.errors import BrokenRequest, WrongEncoding

GZIP = "gzip"
ACCEPTED = "gzip, identity"  #: codings that a body may come in, as `Accept-Encoding` of an answer (RFC 7694)
LEVEL = 5
PIECE = 1 << 18  #: bytes that are decoded at a time
_WBITS = 31  #: zlib.h: a window of 32 kB, and the header and trailer of gzip
_TEXTS = re.compile(
    r"(text/(?!event-stream)|application/([a-z0-9.-]+\+)?(json|xml)\b|application/javascript|image/svg)"
)


class Coding(Protocol):
    """What takes the coding off a body."""

    def decoded(self, data: bytes) -> Iterator[bytes]:
        """Yield what the next piece holds, at most `PIECE` bytes at a time. Raises BrokenRequest."""

    def finish(self) -> None:
        """Note that the body has ended. Raises BrokenRequest where it may not end here."""


def coding_of(headers: Headers) -> Coding:
    """Return what decodes the body of a request. Raises WrongEncoding."""
    codings = [
        name.strip().lower() for line in headers.getlist("content-encoding") for name in line.split(",")
    ]
    named = [name for name in codings if name not in ("", "identity")]
    if not named:
        return _Identity()
    if named in (["gzip"], ["x-gzip"]):
        return _Gzip()
    raise WrongEncoding(f"the body comes as {', '.join(named)[:100]}; send it as it is, or as gzip, once")


class _Identity:
    def decoded(self, data: bytes) -> Iterator[bytes]:
        yield data

    def finish(self) -> None:
        pass


class _Gzip:
    """Decodes members of gzip, one behind another (RFC 1952, Section 2.2)."""

    def __init__(self) -> None:
        self._member = zlib.decompressobj(_WBITS)
        self._begun = False

    def decoded(self, data: bytes) -> Iterator[bytes]:
        try:
            while data:
                if self._member.eof:
                    self._member = zlib.decompressobj(_WBITS)
                self._begun = True
                if part := self._member.decompress(data, PIECE):
                    yield part
                data = self._member.unused_data if self._member.eof else self._member.unconsumed_tail
        except zlib.error as error:
            raise BrokenRequest(f"the body is not gzip, as its Content-Encoding says: {error}") from error

    def finish(self) -> None:
        if not self._begun or not self._member.eof:
            raise BrokenRequest("the body ends within its gzip; nothing was kept, send it again")


def accepts_gzip(headers: Headers) -> bool:
    """Tell whether an answer may be gzip (RFC 9110, Section 12.5.3); without a word of it, it may not."""
    weights: dict[str, float] = {}
    for entry in ",".join(headers.getlist("accept-encoding")).split(","):
        name, _, parameter = entry.partition(";")
        weights[name.strip().lower()] = _weight(parameter)
    return weights.get(GZIP, weights.get("x-gzip", weights.get("*", 0.0))) > 0


def shrinks(media_type: str) -> bool:
    """Tell whether an answer of a media type is worth coding: text is, clouds, pictures and streams of events are not."""
    return _TEXTS.match(media_type.lower()) is not None


def packed(data: bytes) -> bytes:
    """Return bytes as one member of gzip; the same bytes give the same, for no time stands in it."""
    packer = packer_of()
    return packer.compress(data) + packer.flush()


def packer_of() -> zlib._Compress:
    """Return what packs an answer piece by piece."""
    return zlib.compressobj(LEVEL, zlib.DEFLATED, _WBITS)


def _weight(parameter: str) -> float:
    name, _, value = parameter.replace(" ", "").partition("=")
    if name.lower() != "q":
        return 1.0
    try:
        return float(value)
    except ValueError:
        return 0.0
