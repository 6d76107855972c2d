"""Digests of what is sent and received: `Content-Digest` and `Repr-Digest` (RFC 9530), sha-256 and sha-512.

The body of a request is a whole representation here, so that both headers speak of the same bytes: those that came,
before a content coding is taken off (RFC 9530, Sections 2 and 3).
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from typing import cast

import http_sf
from starlette.datastructures import Headers

from service.errors import BrokenRequest, WrongDigest

ALGORITHMS = ("sha-256", "sha-512")  #: those of the registry that are neither broken nor a checksum
_LENGTHS = {"sha-256": 32, "sha-512": 64}  #: bytes
_REQUEST = ("Content-Digest", "Repr-Digest")


class ExpectedDigests:
    """What a request says of its body, held against the bytes as they come."""

    def __init__(self, headers: Headers) -> None:
        """Read the headers of a request; algorithms that are not known are ignored. Raises BrokenRequest."""
        self._expected = [
            (name, algorithm, digest)
            for name in _REQUEST
            for algorithm, digest in _digests(name, headers.getlist(name)).items()
        ]
        self._hashes = {algorithm: _hash(algorithm) for _, algorithm, _ in self._expected}

    def update(self, data: bytes) -> None:
        """Take the next piece of the body."""
        for digest in self._hashes.values():
            digest.update(data)

    def check(self) -> None:
        """Compare, once the body has ended. Raises WrongDigest."""
        for name, algorithm, expected in self._expected:
            actual = self._hashes[algorithm].digest()
            if actual != expected:
                raise WrongDigest(
                    f"the {algorithm} of the body is {_written(actual)} and {name} says {_written(expected)}; nothing "
                    "was kept, send it again"
                )


def wanted(headers: Headers, name: str) -> str | None:
    """Return the algorithm of ours that `Want-Content-Digest` or `Want-Repr-Digest` prefers (RFC 9530, Section 4).

    None where it wants none, and where it cannot be read: it is a wish, and no answer depends on it.
    """
    try:
        asked = _dictionary(headers.getlist(name))
    except ValueError:
        return None
    wishes = {key: value for key, value in asked.items() if key in ALGORITHMS and type(value) is int}
    best = max(wishes, key=lambda key: wishes[key], default=None)
    return best if best is not None and wishes[best] > 0 else None


def digest_of(algorithm: str, data: bytes) -> str:
    """Return the digest of some bytes as a header has it."""
    digest = _hash(algorithm)
    digest.update(data)
    return field_of(algorithm, digest.digest())


def field_of(algorithm: str, digest: bytes) -> str:
    """Return a digest as a header has it: a dictionary of one byte sequence (RFC 9651)."""
    return f"{algorithm}={_written(digest)}"


def _digests(name: str, lines: list[str]) -> dict[str, bytes]:
    try:
        values = _dictionary(lines)
    except ValueError as error:
        raise BrokenRequest(f"{name} cannot be read (RFC 9530): {error}") from error
    known = {algorithm: value for algorithm, value in values.items() if algorithm in ALGORITHMS}
    for algorithm, value in known.items():
        if not isinstance(value, bytes) or len(value) != _LENGTHS[algorithm]:
            raise BrokenRequest(
                f"{name} gives no {algorithm} of {_LENGTHS[algorithm]} bytes; write it as `{algorithm}=:BASE64:`"
            )
    return known  # type: ignore[return-value]  # all are bytes now


def _dictionary(lines: list[str]) -> Mapping[str, object]:
    """Return the bare values of a structured field (RFC 9651, Section 3.2). Raises ValueError."""
    if not lines:
        return {}
    parsed = http_sf.parse(", ".join(lines).encode("latin-1"), tltype="dictionary")
    return {
        str(name): value[0] for name, value in cast("Mapping[str, tuple[object, object]]", parsed).items()
    }


def _hash(algorithm: str) -> hashlib._Hash:
    return hashlib.new(algorithm.replace("-", ""))


def _written(digest: bytes) -> str:
    return f":{base64.b64encode(digest).decode()}:"
