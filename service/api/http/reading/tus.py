"""Headers of tus 1.0.0 (https://tus.io/protocols/resumable-upload): what they say, and how they break."""

from __future__ import annotations

import base64
import binascii
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from email.utils import format_datetime
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.catalog.files.uploads import UploadRecord
from service.errors import ChecksumMismatch, TooLarge, TusMalformed, TusVersion

VERSION = "1.0.0"
EXTENSIONS = ("creation", "creation-with-upload", "checksum", "expiration", "termination")
ALGORITHMS = ("sha1", "sha256")
PIECE_TYPE = "application/offset+octet-stream"
#: What clients of others say of a file by themselves: `name` serves where `filename` is not said, the rest says nothing.
_OF_OTHERS = frozenset({"name", "type", "filetype", "relativePath"})
_PREFIX = "/uploads"


@dataclass(frozen=True, kw_only=True, slots=True)
class Checksum:
    """What a piece is to add up to."""

    algorithm: str
    digest: bytes

    def start(self) -> Any:
        """Return a hash to feed with the piece."""
        return hashlib.new(self.algorithm, usedforsecurity=False)

    def check(self, fed: Any) -> None:
        """Raise ChecksumMismatch where the piece is another one."""
        if fed.digest() != self.digest:
            raise ChecksumMismatch(
                f"the piece has the {self.algorithm} {fed.hexdigest()}, and {self.digest.hex()} was announced; nothing "
                "of it was kept, send it again"
            )


def require_version(headers: Headers) -> None:
    """Raise TusVersion where a request does not speak this version."""
    if (spoken := headers.get("tus-resumable")) != VERSION:
        said = "no Tus-Resumable header" if spoken is None else f"Tus-Resumable: {spoken[:40]}"
        raise TusVersion(f"{said}; send `Tus-Resumable: {VERSION}`")


def length_of(headers: Headers, limit: int) -> int:
    """Return `Upload-Length`, the bytes of the whole file. Raises TusMalformed, TooLarge."""
    if "upload-length" not in headers:
        raise TusMalformed(
            "no Upload-Length; its deferring is not spoken here, say how many bytes the file has"
        )
    length = _whole_number(headers, "upload-length")
    if length > limit:
        raise TooLarge(f"the file has {length} bytes, more than the {limit} that are taken")
    return length


def offset_of(headers: Headers) -> int:
    """Return `Upload-Offset`, where a piece begins. Raises TusMalformed."""
    if "upload-offset" not in headers:
        raise TusMalformed("no Upload-Offset; HEAD tells where the upload goes on")
    return _whole_number(headers, "upload-offset")


def checksum_of(headers: Headers) -> Checksum | None:
    """Return `Upload-Checksum`, where there is one. Raises TusMalformed."""
    if (value := headers.get("upload-checksum")) is None:
        return None
    algorithm, _, encoded = value.strip().partition(" ")
    if algorithm not in ALGORITHMS:
        raise TusMalformed(f"checksums by {algorithm[:20]!r} are not taken; use {' or '.join(ALGORITHMS)}")
    digest = _decoded(encoded.strip(), "Upload-Checksum")
    if len(digest) != hashlib.new(algorithm, usedforsecurity=False).digest_size:
        raise TusMalformed(f"Upload-Checksum has {len(digest)} bytes, which no {algorithm} has")
    return Checksum(algorithm=algorithm, digest=digest)


def metadata_of(headers: Headers) -> dict[str, str]:
    """Return `Upload-Metadata`, each value as text, by the names that a scan has. Raises TusMalformed."""
    said: dict[str, str] = {}
    for entry in headers.get("upload-metadata", "").split(","):
        name, _, encoded = entry.strip().partition(" ")
        if not name:
            continue
        if name in said:
            raise TusMalformed(f"Upload-Metadata has {name[:40]!r} twice")
        try:
            said[name] = _decoded(encoded.strip(), f"Upload-Metadata: {name[:40]}").decode()
        except UnicodeDecodeError as error:
            raise TusMalformed(f"Upload-Metadata: {name[:40]} is not UTF-8") from error
    of_others = {name: said.pop(name) for name in _OF_OTHERS & said.keys()}
    if of_others.get("name"):
        said.setdefault("filename", of_others["name"])
    return {name: value for name, value in said.items() if value}


def told(record: UploadRecord, root_path: str = "") -> dict[str, str]:
    """Return the headers that tell of an upload; of one that became a scan, where that is as well."""
    headers = {"Upload-Offset": str(record.offset), "Cache-Control": "no-store"}
    if record.scan_id is not None:
        headers["Scan-Id"] = record.scan_id
        headers["Link"] = f'<{root_path}/scans/{record.scan_id}>; rel="related"; type="application/json"'
    else:
        headers["Upload-Expires"] = format_datetime(record.expires, usegmt=True)
    return headers


def documented(name: str, schema: dict[str, Any], *, required: bool = False) -> dict[str, Any]:
    """Return a header of a request as OpenAPI has it."""
    return {"name": name, "in": "header", "required": required, "schema": schema}


def _whole_number(headers: Mapping[str, str], name: str) -> int:
    value = headers[name]
    if not (value.isascii() and value.isdigit() and len(value) <= 18):
        raise TusMalformed(f"{name.title()} is {value[:40]!r}, which is no number of bytes")
    return int(value)


def _decoded(encoded: str, where: str) -> bytes:
    try:
        return base64.b64decode(encoded, validate=True)
    except (binascii.Error, ValueError) as error:
        raise TusMalformed(f"{where} is not base64") from error


class TusHeaders:
    """Adds `Tus-Resumable` to every answer under /uploads, to problems as well (ASGI)."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and add to its answer."""

        async def add(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Tus-Resumable"] = VERSION
                if message["status"] == 412:
                    headers["Tus-Version"] = VERSION
            await send(message)

        path = scope.get("path", "").removeprefix(scope.get("root_path", ""))
        is_ours = scope["type"] == "http" and (path == _PREFIX or path.startswith(f"{_PREFIX}/"))
        await self._app(scope, receive, add if is_ours else send)
