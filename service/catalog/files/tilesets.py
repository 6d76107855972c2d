"""Where the contents of a tileset lie: all in one blob, each under an address that says which bytes are its own.

So no index has to be read for a content, and a blob store that takes a while for each request (S3) is asked once. The
address bears the digest of all contents as well: the ids of maps and the numbers of versions may be given again once a
map is deleted, but what lies under the address of a content never changes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self

from service.catalog.files.blobs import Blobs

MOST_BYTES = 1 << 24  #: of a content that is answered; those that are written are a tenth of it
_DIGITS = 16  # of the digest
_NAME = re.compile(r"([0-9a-f]{16})-([0-9]{1,15})-([0-9]{1,8})\.glb")
_MAGIC = b"glTF\x02\x00\x00\x00"


@dataclass(frozen=True, kw_only=True, slots=True)
class ContentName:
    """What the last part of a content's address says."""

    digest: str  #: the first digits of the SHA-256 of all contents
    offset: int  #: in the blob
    length: int  #: bytes

    @classmethod
    def of(cls, name: str) -> Self | None:
        """Read a name; None where it is none."""
        match = _NAME.fullmatch(name)
        if match is None or int(match[3]) > MOST_BYTES:
            return None
        return cls(digest=match[1], offset=int(match[2]), length=int(match[3]))

    def is_of(self, sha256: str) -> bool:
        """Tell whether it names a content of the tileset whose contents have this digest."""
        return self.digest == sha256[:_DIGITS]


def address(sha256: str, offset: int, length: int) -> str:
    """Return the address of a content, relative to `tileset.json`."""
    return f"tileset/{sha256[:_DIGITS]}-{offset}-{length}.glb"


def read_content(blobs: Blobs, key: str, name: ContentName) -> bytes:
    """Return a content out of the blob under `key`.

    Raises FileNotFoundError where there is no such blob, or none of its contents is there: a GLB tells its own length
    (ISO/IEC 12113, Section 4.4), so that other bytes are noticed.
    """
    content = blobs.get_range(key, name.offset, name.length)
    if content[:12] != _MAGIC + name.length.to_bytes(4, "little") or len(content) != name.length:
        raise FileNotFoundError(f"{key} has no content of {name.length} bytes at {name.offset}")
    return content
