"""Files that their owner alone reads: scans of a building are nobody else's on the machine."""

from __future__ import annotations

import contextlib
import logging
import os
import stat
from collections.abc import Iterator
from pathlib import Path

PRIVATE_UMASK = 0o077
_OTHERS = stat.S_IRWXG | stat.S_IRWXO

log = logging.getLogger("spicd")


@contextlib.contextmanager
def private_files() -> Iterator[None]:
    """Have what this process and its children make from now on be 0700 and 0600, until the block ends."""
    before = os.umask(PRIVATE_UMASK)
    try:
        yield
    finally:
        os.umask(before)


def make_private(folder: Path) -> None:
    """Make a folder of ours where there is none, and take it and all in it away from group and others.

    What is not ours to change is left, with a warning; so are links and, as a whole, a folder that is shared on purpose
    (`/`, `/tmp`). Raises OSError where the folder cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if folder.resolve() == folder.resolve().parent or folder.stat().st_mode & stat.S_ISVTX:
        log.warning(
            "the data folder %s is shared with others; name one of its own with SPICD_DATA_DIR", folder
        )
        return
    kept = sum(not _tightened(path) for path in _all(folder))
    if kept:
        log.warning("%d files of others in %s stay readable to whoever they let", kept, folder)


def _all(folder: Path) -> Iterator[Path]:
    yield folder
    for parent, folders, files in os.walk(folder):  # it follows no links
        yield from (Path(parent, name) for name in (*folders, *files))


def _tightened(path: Path) -> bool:
    """Take a file or folder away from others; False where that is not ours to do."""
    try:
        mode = path.lstat().st_mode
        if not stat.S_ISLNK(mode) and mode & _OTHERS:
            path.chmod(stat.S_IMODE(mode) & ~_OTHERS)
    except FileNotFoundError:  # another process removed it
        return True
    except OSError:
        return False
    return True
