"""A folder for what a step writes aside, which goes with the step however it ends.

The step holds a lock on its folder (flock(2)). The kernel lets go of it when the process ends, so whoever gets the lock
knows that nobody works there any more, also across containers of one machine that share the folder.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

_LOCK = ".lock"
_shared = False  #: whether this process has one folder for the temporary files of all of its steps
_UNLOCKED_S = 60.0  #: a folder without a lock may be just in the making; after this it is not


@contextmanager
def scratch_folder(parent: Path, name: str) -> Iterator[Path]:
    """Make a folder under `parent` for the length of the block; temporary files of any library go there too.

    Not these within `shared_temporary`.
    """
    parent.mkdir(parents=True, exist_ok=True)
    folder, lock = _locked_folder(parent, name)
    try:
        with nullcontext() if _shared else _temporary_in(folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


@contextmanager
def shared_temporary(parent: Path, name: str) -> Iterator[Path]:
    """Have the temporary files of all steps of this process in one folder, for the length of the block.

    Where they go is one for the whole process, so that of several steps at a time none may say where.
    """
    global _shared  # noqa: PLW0603 - so is this
    with scratch_folder(parent, name) as folder:
        _shared = True
        try:
            yield folder
        finally:
            _shared = False


@contextmanager
def _temporary_in(folder: Path) -> Iterator[None]:
    """Have temporary files in a folder, also those of the processes that are started."""
    before = tempfile.tempdir, os.environ.get("TMPDIR")
    try:
        tempfile.tempdir = str(folder)
        os.environ["TMPDIR"] = str(folder)
        yield
    finally:
        tempfile.tempdir = before[0]
        if before[1] is None:
            os.environ.pop("TMPDIR", None)
        else:
            os.environ["TMPDIR"] = before[1]


def _locked_folder(parent: Path, name: str) -> tuple[Path, int]:
    """Make a folder and lock it; another one where a sweep had it between the two."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f"{name}.", dir=parent))
        lock = os.open(
            folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o600
        )  # no program that is started inherits it
        fcntl.flock(lock, fcntl.LOCK_EX)
        if os.fstat(lock).st_nlink:
            return folder, lock
        os.close(lock)


def sweep(parent: Path) -> int:
    """Remove the folders under `parent` that no step holds any more; return how many."""
    with suppress(FileNotFoundError):
        return sum(_swept(folder) for folder in list(parent.iterdir()))
    return 0


def _swept(folder: Path) -> bool:
    try:
        lock = os.open(folder / _LOCK, os.O_RDWR)
    except FileNotFoundError:
        with suppress(FileNotFoundError):
            if time.time() - folder.stat().st_mtime > _UNLOCKED_S:
                shutil.rmtree(folder, ignore_errors=True)
                return True
        return False
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    except BlockingIOError:
        return False
    finally:
        os.close(lock)
    return True
