"""Files that are seen whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path


def write_atomically(path: Path, write: Callable[[Path], object]) -> Path:
    """Have `write` make the file under another name beside `path`, then rename it; returns `path`.

    A reader never sees half a file, and a failed write leaves an earlier file as it was. What `write`
    raises passes, and what it had written is removed.
    """
    aside = path.with_name(path.name + ".part")
    try:
        write(aside)
        aside.replace(path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    return path


def write_bytes(path: Path, *parts: bytes) -> Path:
    """Write these bytes, one part after the other, atomically."""
    return write_parts(path, parts)


def write_parts(path: Path, parts: Iterable[bytes]) -> Path:
    """Write the parts atomically as they come: one is in memory at a time."""

    def write(aside: Path) -> None:
        with aside.open("wb") as file:
            for part in parts:
                file.write(part)

    return write_atomically(path, write)


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text atomically."""
    return write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))
