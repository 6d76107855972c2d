"""The part of a file that has come: it lies beside the file until it is whole, and may be gone on with later."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from service.client.errors import RequestRefused

_TAG = re.compile(r'"[\x21\x23-\x7e]{0,1000}"')  # a strong entity tag (RFC 9110, Section 8.8.3), of ASCII


class Part:
    """`cloud.ply.part` beside `cloud.ply`, and in `cloud.ply.part.tag` the entity tag of what it is a part of.

    With `kept` it stays where the connection, the process or the disk gives out; without, nothing does.
    """

    def __init__(self, to: Path, *, kept: bool) -> None:
        self._to, self._kept = to, kept
        self._path = to.with_name(f"{to.name}.part")
        self._note = to.with_name(f"{to.name}.part.tag")
        self.tag: str | None = None  #: of the file that it is a part of; None: it cannot be gone on with

    @contextlib.contextmanager
    def opened(self) -> Iterator[BinaryIO]:
        """Yield the part, at its end; once the block is done it is the file. Raises OSError."""
        self.tag = self._noted() if self._kept else None
        try:
            if self.tag is None:
                self._note.unlink(missing_ok=True)
            with self._path.open("wb" if self.tag is None else "r+b") as file:
                file.seek(0, os.SEEK_END)
                yield file
            self._path.replace(self._to)
            self.tag = None
        except RequestRefused:
            self.tag = None
            raise
        finally:
            if not self._kept or self.tag is None:
                self._path.unlink(missing_ok=True)
                self._note.unlink(missing_ok=True)

    def of(self, tag: str | None) -> None:
        """Note of what the next bytes are a part, before they come: whoever is killed leaves no bytes of another file."""
        if tag == self.tag:
            return
        self.tag = tag
        if self._kept:
            self._note.unlink(missing_ok=True)
        if self._kept and tag is not None:
            self._note.write_text(tag, "ascii")

    def _noted(self) -> str | None:
        """Return the tag of a part that an earlier call left; None where there is none."""
        try:
            tag = self._note.read_text("ascii")
        except (OSError, ValueError):
            return None
        return tag if _TAG.fullmatch(tag) and self._path.is_file() else None
