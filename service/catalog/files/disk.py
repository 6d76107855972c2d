"""The disk of the data folder: a reserve under which nothing new is taken, and a ballast that lets a full one be emptied.

Deleting needs space too, for the database writes down what it is about to change. A file of some megabytes, the ballast,
is there to be given up for that, and is made again once there is room.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from service.errors import DiskFull, is_disk_full

log = logging.getLogger(__name__)
T = TypeVar("T")

BALLAST_BYTES = 16 << 20  #: the log of deleting a map of some ten thousand tiles, with room to spare
_LEAST_BYTES = 4 << 20  #: to start with: the logs of the database and of Redis
_NAME = "ballast"
_MIB = 1 << 20


class Disk:
    """What is left of one disk; safe to share between threads."""

    def __init__(self, folder: Path, *, reserve: int, ballast: int = BALLAST_BYTES) -> None:
        """Watch the disk of `folder`. `reserve`, in bytes, is to stay free; 0 watches nothing. `ballast` 0 keeps none."""
        self._folder = folder
        self._reserve = reserve
        self._ballast = ballast
        self._lock = threading.Lock()

    def free(self) -> int:
        """Return the bytes that are left."""
        return shutil.disk_usage(self._folder).free

    def require(self, coming: int = 0) -> None:
        """Return while `coming` further bytes leave the reserve untouched. Raises DiskFull."""
        if self._reserve == 0:
            return
        lacks_ballast = self._ballast > 0 and not self._path.exists()
        free = self.free() - (
            self._ballast if lacks_ballast else 0
        )  # what was given up for deleting is for deleting
        if free - coming < self._reserve:
            raise DiskFull(
                f"{max(free, 0) // _MIB} MiB are free in the data folder, and {self._reserve // _MIB} MiB of them are kept "
                f"(SPICD_MIN_FREE_BYTES){f'; {coming} bytes were to come' if coming else ''}; delete surveys or maps, "
                "or enlarge the disk"
            )
        if lacks_ballast:
            self.load_ballast()

    def make_room(self) -> bool:
        """Give the ballast up where hardly anything else is left; False where that is not enough to work with."""
        return self.free() >= _LEAST_BYTES or (self.drop_ballast() and self.free() >= _LEAST_BYTES)

    def freeing(self, call: Callable[[], T]) -> T:
        """Call something that deletes; where no space is left to do so, once more without the ballast."""
        try:
            result = call()
        except Exception as error:
            if not is_disk_full(error) or not self.drop_ballast():
                raise
            result = call()
        self.load_ballast()
        return result

    def drop_ballast(self) -> bool:
        """Give the ballast up; False where there is none."""
        with self._lock:
            try:
                self._path.unlink()
            except FileNotFoundError:
                return False
            log.warning("the disk is full; %d MiB of ballast were given up", self._ballast // _MIB)
            return True

    def load_ballast(self) -> None:
        """Make the ballast again, unless it is there or would take more than a quarter of what is left."""
        with self._lock, contextlib.suppress(OSError):
            if self._ballast == 0 or self._path.exists() or self.free() < 4 * self._ballast:
                return
            aside = self._path.with_suffix(".part")
            try:
                with aside.open("wb") as file:
                    os.posix_fallocate(file.fileno(), 0, self._ballast)
                aside.replace(self._path)
            finally:
                aside.unlink(missing_ok=True)

    @property
    def _path(self) -> Path:
        return self._folder / _NAME
