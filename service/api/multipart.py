"""multipart/form-data, read as it comes (RFC 7578): files go to disk at once, fields stay small in memory.

The framework's own form would keep every file in a spool of its own and only then hand it over, too late for a limit.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.api.incoming import Incoming, Upload
from service.errors import BadRequest, TooLarge

MAX_FIELDS_BYTES = 1 << 20  #: of all fields together
MAX_PARTS = 2000


class Form:
    """A form being received; `feed` and `finish` block on the disk and so run in a thread."""

    def __init__(self, boundary: bytes, folder: Path, kept: ExitStack, file_fields: frozenset[str]) -> None:
        """Files of `file_fields` go to `folder`, and `kept` removes them at its end."""
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
        """The body has ended. Raises BadRequest when the form has not."""
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
