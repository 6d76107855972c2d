"""A disk of some megabytes, which can be filled for real."""

from __future__ import annotations

import contextlib
import errno
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

_PIECE = 1 << 16


class SmallDisk:
    """A file system of its own at `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filling = folder / "filling"

    def fill(self, *, leave: int = 0) -> None:
        """Write until nothing more goes in, then give `leave` bytes back."""
        with self._filling.open("ab", buffering=0) as file:
            for size in (_PIECE, 4096, 1):
                while _written(file.write, bytes(size)) == size:
                    pass
            file.truncate(max(0, file.tell() - leave))

    def clear(self) -> None:
        """Take away what `fill` wrote."""
        self._filling.unlink()

    def free(self) -> int:
        return shutil.disk_usage(self.folder).free


def _written(write: object, data: bytes) -> int:
    try:
        return int(write(data))  # type: ignore[operator]
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        return 0


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[SmallDisk]:
    """Mount a disk at `folder`; skip the test where that is not allowed."""
    folder.mkdir()
    options = f"size={megabytes}m,mode=0700"
    try:
        subprocess.run(
            ["/bin/mount", "-t", "tmpfs", "-o", options, "spicd-test", str(folder)],
            check=True,
            capture_output=True,
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no small disk: mount is not allowed here")
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["/bin/umount", "--lazy", str(folder)], check=True)
