"""Bodies of requests: JSON, a form with files, or one raw file, in memory that does not grow with the body.

Forms (multipart/form-data, RFC 7578) are read as they come: files go to disk at once, fields stay small in memory. The
framework's own form would keep every file in a spool of its own and only then hand it over, too late for a limit.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from json import dumps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.api.http.answering.json_text import read_json
from service.api.http.dependencies import Services
from service.api.http.description import not_null
from service.api.http.reading.codings import Coding, coding_of
from service.api.http.reading.digests import ExpectedDigests
from service.api.http.reading.uploads import Incoming, Upload
from service.catalog.files.disk import Disk
from service.errors import (
    BadRequest,
    BrokenRequest,
    DiskFull,
    TooLarge,
    TooSlow,
    WrongMediaType,
    is_disk_full,
)

P = ParamSpec("P")
T = TypeVar("T")

PIECE = 1 << 18  #: bytes handed to the disk at a time; each upload holds as many in memory
MAX_JSON_BYTES = 1 << 20
MAX_JSON_S = 300
MAX_FIELDS_BYTES = 1 << 20  #: of all fields of a form together
MAX_BOUNDARY = 70  #: letters
MAX_PARTS = 2000  #: of a form
INCOMING = (
    "incoming"  #: folder in the data folder; on the disk of the blobs, so that keeping a file is a rename
)

JSON = "application/json"
FORM = "multipart/form-data"
RAW = "application/octet-stream"
LAZ = "application/vnd.laszip"
_BINARY = {"type": "string", "format": "binary"}
_REFERENCE = "#/components/schemas/{model}"


@dataclass(frozen=True, kw_only=True, slots=True)
class Body:
    """What a request brought; the files go when the request ends."""

    fields: dict[str, Any] = field(default_factory=dict)
    uploads: tuple[Upload, ...] = ()


@contextlib.asynccontextmanager
async def received(
    request: Request,
    services: Services,
    *,
    takes: tuple[str, ...] = (JSON, FORM),
    files: str = "scans",
    filename: str | None = None,
    needs_space: bool = True,
) -> AsyncIterator[Body]:
    """Receive the body of a request in one of the media types `takes`.

    `files` names the form field of files; `filename` that of a raw body. `needs_space` is said of a request that makes
    anything larger than its row. The limits are those of the body as it came and as it is once decoded. Raises
    WrongMediaType, WrongEncoding, WrongDigest, BrokenRequest, TooLarge, BadRequest, ScanUnreadable, DiskFull; leaves
    nothing behind whichever way it ends.
    """
    _require_whole(request)
    settings = services.settings
    disk = services.catalog.disk if needs_space else None
    media_type, options = _media_type(request)
    if media_type not in takes:
        said = media_type or "no media type"
        raise WrongMediaType(f"the body comes as {said}; send it as {' or '.join(takes)}")
    folder = settings.data_dir / INCOMING
    limit = MAX_JSON_BYTES if media_type == JSON else settings.max_upload_bytes
    seconds = MAX_JSON_S if media_type == JSON else settings.upload_timeout_s
    await run_in_threadpool(_on_disk, _make, folder)
    if disk is not None:
        await run_in_threadpool(disk.require, 0 if media_type == JSON else _declared(request, limit))
    kept = ExitStack()
    try:
        if media_type == JSON:
            text = bytearray()
            await _pour(request, text.extend, limit=limit, seconds=seconds)
            yield Body(fields=await run_in_threadpool(_json, bytes(text)))
        elif media_type == FORM:
            if not options.get(b"boundary"):
                raise BadRequest("the Content-Type names no boundary; let the HTTP library write this header")
            if len(options[b"boundary"]) > MAX_BOUNDARY:
                raise BadRequest(
                    f"the boundary has more than {MAX_BOUNDARY} letters (RFC 2046, Section 5.1.1)"
                )
            form = Form(options[b"boundary"], folder, kept, frozenset({files}))
            await _pour(request, form.feed, limit=limit, seconds=seconds, disk=disk)
            form.finish()
            yield Body(fields=form.fields, uploads=tuple(form.uploads))
        else:
            file = await run_in_threadpool(_on_disk, _opened, kept, folder, filename or "")
            await _pour(request, file.write, limit=limit, seconds=seconds, disk=disk)
            yield Body(uploads=(await run_in_threadpool(_on_disk, file.finish),))
    finally:
        await run_in_threadpool(kept.close)


def documented(
    *,
    json: type[BaseModel] | None = None,
    raw: bool = False,
    form: type[BaseModel] | None = None,
    file: str = "file",
) -> dict[str, Any]:
    """Return the `openapi_extra` of a route that reads its body by hand; `file` is the form field of files."""
    content: dict[str, Any] = {}
    if raw:
        content[RAW] = {"schema": _BINARY}
    if json is not None:
        content[JSON] = {"schema": {"$ref": _REFERENCE.format(model=json.__name__)}}
    if form is not None:
        content[FORM] = {"schema": _form_schema(form, file)}
    return {"requestBody": {"required": True, "content": content}}


def _form_schema(form: type[BaseModel], file: str) -> dict[str, Any]:
    """Return the schema of a form: the fields of a request beside its files, one schema, for it admits no others."""
    schema = form.model_json_schema(ref_template=_REFERENCE)
    fields = {name: _form_field(field) for name, field in schema["properties"].items()}
    fields[file] = _BINARY if file == "file" else {"type": "array", "items": _BINARY}
    needed = [*schema.get("required", ()), *(["file"] if file == "file" else ())]
    said = {"title": form.__name__.replace("Request", "Form"), "description": form.__doc__ or ""}
    whole = {"type": "object", "additionalProperties": False, "properties": fields, **said}
    return {**whole, "required": needed} if needed else whole


def _form_field(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a field of a form: a list of lists comes as one text, for a list is a field repeated."""
    field = not_null(schema)
    if field.get("items", {}).get("type") != "array":
        return field
    return {
        "type": "string",
        "contentMediaType": JSON,
        "description": field.get("description", ""),
        "examples": [dumps(field["example"])] if "example" in field else [],
    }


def _declared(request: Request, limit: int) -> int:
    """Return how long the body says it is, in bytes, 0 where it does not. Raises TooLarge."""
    declared = request.headers.get("content-length", "")
    if not (declared.isascii() and declared.isdigit()):
        return 0
    if len(declared) > 18 or int(declared) > limit:
        raise TooLarge(f"the body has {declared[:40]} bytes, more than the {limit} that are taken")
    return int(declared)


async def _pour(
    request: Request,
    take: Callable[[bytes], None],
    *,
    limit: int,
    seconds: float,
    disk: Disk | None = None,
) -> None:
    """Hand the body to `take` in pieces, in a thread.

    Raises TooLarge and DiskFull as soon as it is, also without a length, and TooSlow. The server ends a body that
    stalls before that, see service/up/connections.py.
    """
    try:
        async with asyncio.timeout(seconds) as clock:
            await _stream(request, take, limit, disk)
    except TimeoutError as error:
        if not clock.expired():  # a disk has time limits too
            raise
        raise TooSlow(f"the body took longer than {seconds:g} s; send less at a time") from error


async def _stream(request: Request, take: Callable[[bytes], None], limit: int, disk: Disk | None) -> None:
    _declared(request, limit)
    intake = _Intake(request, take, limit, disk)
    size = 0
    piece = bytearray()
    async for chunk in request.stream():
        size += len(chunk)
        if size > limit:
            raise TooLarge(f"the body has more than the {limit} bytes that are taken")
        piece += chunk
        if len(piece) >= PIECE:
            await run_in_threadpool(intake.feed, bytes(piece))
            piece.clear()
    if piece:
        await run_in_threadpool(intake.feed, bytes(piece))
    intake.finish()


class _Intake:
    """Between the body as it comes and who takes it: holds it against its digests, decodes it, and bounds it."""

    def __init__(
        self, request: Request, take: Callable[[bytes], None], limit: int, disk: Disk | None
    ) -> None:
        """Raises WrongEncoding and BrokenRequest for headers that cannot be met."""
        self._take, self._limit, self._disk = take, limit, disk
        self._coding: Coding = coding_of(request.headers)
        self._digests = ExpectedDigests(request.headers)
        self._size = 0

    def feed(self, piece: bytes) -> None:
        """Hand a piece on, in a thread. Raises TooLarge, BrokenRequest, DiskFull."""
        self._digests.update(piece)
        for part in self._coding.decoded(piece):
            self._size += len(part)
            if self._size > self._limit:
                raise TooLarge(f"the body has more than the {self._limit} bytes that are taken, once decoded")
            if self._disk is not None:
                self._disk.require(len(part))
            _on_disk(self._take, part)

    def finish(self) -> None:
        """Note that the body has ended. Raises BrokenRequest and WrongDigest."""
        self._digests.check()
        self._coding.finish()


def _require_whole(request: Request) -> None:
    """Raise BrokenRequest for a part of something: to take it for the whole is to lose the rest (RFC 9110, 14.5)."""
    if (content_range := request.headers.get("content-range")) is not None:
        raise BrokenRequest(
            f"the body is the part {content_range[:100]!r} of something; send all of it at once"
        )


def _make(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)


def _opened(kept: ExitStack, folder: Path, filename: str) -> Incoming:
    """Open a file that `kept` removes, also where the request is gone by the time that it is open."""
    return kept.enter_context(Incoming(folder, filename))


def _on_disk(call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call what writes to the data folder, in a thread: the last bytes go out when a file is closed. Raises DiskFull."""
    try:
        return call(*args, **kwargs)
    except OSError as error:
        if not is_disk_full(error):
            raise
        raise DiskFull(
            "the disk of the data folder is full; delete surveys or maps, or enlarge it"
        ) from error


def _media_type(request: Request) -> tuple[str, dict[bytes, bytes]]:
    kind, options = parse_options_header(request.headers.get("content-type", ""))
    return kind.decode("latin-1").lower(), options


def _json(text: bytes) -> dict[str, Any]:
    if not text.strip():
        raise BadRequest("the body is empty; send a JSON object")
    try:
        fields = read_json(text)
    except ValueError as error:
        raise BadRequest(f"the body is not JSON: {error}") from error
    if not isinstance(fields, dict):
        raise BadRequest(f"the body is a JSON {type(fields).__name__}; send an object")
    return fields


class Form:
    """A form being received; `feed` and `finish` block on the disk and so run in a thread."""

    def __init__(self, boundary: bytes, folder: Path, kept: ExitStack, file_fields: frozenset[str]) -> None:
        """Keep files of `file_fields` in `folder`, where `kept` removes them at its end."""
        self.fields: dict[str, Any] = {}
        self.uploads: list[Upload] = []
        self._folder, self._kept, self._file_fields = folder, kept, file_fields
        self._header: tuple[bytearray, bytearray] = (bytearray(), bytearray())
        self._disposition = b""
        self._name = ""
        self._file: Incoming | None = None
        self._text = bytearray()
        self._parts = self._text_bytes = 0
        self._ended = False
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._part_begin,
                "on_header_field": self._header_field,
                "on_header_value": self._header_value,
                "on_header_end": self._header_end,
                "on_headers_finished": self._headers_finished,
                "on_part_data": self._part_data,
                "on_part_end": self._part_end,
                "on_end": self._end,
            },
        )

    def feed(self, data: bytes) -> None:
        """Take the next piece of the body. Raises BadRequest, TooLarge, ScanUnreadable."""
        try:
            self._parser.write(data)
        except FormParserError as error:
            raise BadRequest(f"the multipart body cannot be read: {error}") from error

    def finish(self) -> None:
        """Note that the body has ended. Raises BadRequest when the form has not."""
        if not self._ended:
            raise BadRequest("the multipart body ends before its last boundary; send it again")

    def _part_begin(self) -> None:
        self._parts += 1
        if self._parts > MAX_PARTS:
            raise BadRequest(f"more than {MAX_PARTS} parts in one form")
        self._disposition, self._name, self._file = b"", "", None
        self._text = bytearray()

    def _header_field(self, data: bytes, start: int, end: int) -> None:
        self._header[0].extend(data[start:end])

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._header[1].extend(data[start:end])

    def _header_end(self) -> None:
        if bytes(self._header[0]).lower() == b"content-disposition":
            self._disposition = bytes(self._header[1])
        self._header = (bytearray(), bytearray())

    def _headers_finished(self) -> None:
        kind, options = parse_options_header(self._disposition)
        if kind != b"form-data" or b"name" not in options:
            raise BadRequest("a part of the form has no name (Content-Disposition: form-data; name=...)")
        self._name = options[b"name"].decode("utf-8", "replace")
        if b"filename" not in options and self._name not in self._file_fields:
            return
        if self._name not in self._file_fields:
            wanted = " or ".join(repr(name) for name in sorted(self._file_fields))
            raise BadRequest(f"a file in the field {self._name!r}; files go in {wanted}")
        filename = options.get(b"filename", b"scan").decode("utf-8", "replace")
        self._file = self._kept.enter_context(Incoming(self._folder, filename))

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._file is not None:
            self._file.write(memoryview(data)[start:end])
            return
        self._text_bytes += end - start
        if self._text_bytes > MAX_FIELDS_BYTES:
            raise TooLarge(f"the fields of the form hold more than {MAX_FIELDS_BYTES} bytes")
        self._text.extend(data[start:end])

    def _part_end(self) -> None:
        if self._file is not None:
            self.uploads.append(self._file.finish())
            return
        value = self._text.decode("utf-8", "replace")
        known = self.fields.get(self._name)
        if known is None:
            self.fields[self._name] = value
        else:
            self.fields[self._name] = [*(known if isinstance(known, list) else [known]), value]

    def _end(self) -> None:
        self._ended = True
