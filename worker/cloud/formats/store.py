"""Column stores: what a process of its own decoded of a file, in a file without a name that both processes map."""

from __future__ import annotations

import mmap
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.fields import Columns

_COLORS = ("red", "green", "blue")
_AT_ONCE = 1_000_000


class ColumnStore:
    """Columns of N points: x, y, z as float64, and on request red, green, blue as uint16, then as uint8.

    Its space is taken from the disk at once: a full disk is an error then, and not the death of who writes.
    """

    def __init__(self, handle: int) -> None:
        """Lay the columns into the open file `handle`, which is empty."""
        self._handle = handle
        self.n = 0
        self.has_colors = False
        self.positions: dict[str, NDArray[np.float64]] = {}
        self.wide_colors: list[NDArray[np.uint16]] = []

    def allocate(self, n: int, *, colors: bool) -> None:
        """Take the space for `n` points. Raises OSError where the disk has none."""
        self.n, self.has_colors = n, colors
        size = n * (24 + (6 if colors else 0))
        if size == 0:
            self.positions = {name: np.empty(0) for name in "xyz"}
            self.wide_colors = [np.empty(0, np.uint16) for _ in _COLORS]
            return
        os.posix_fallocate(self._handle, 0, size)
        mapped = mmap.mmap(self._handle, size)
        self.positions = _columns(mapped, "xyz", "<f8", n, at=0)
        if colors:
            self.wide_colors = list(_columns(mapped, _COLORS, "<u2", n, at=24 * n).values())

    def finish_colors(self, brightest: int) -> None:
        """Make the colours uint8, in their own place. 16 bits count where any value needs them; black ones go."""
        self.has_colors &= brightest > 0
        if not self.has_colors or not self.n:
            return
        for column in self.wide_colors:
            narrow = column.view(np.uint8)[: self.n]
            for at in range(0, self.n, _AT_ONCE):
                piece = column[at : at + _AT_ONCE].copy()
                narrow[at : at + _AT_ONCE] = piece if brightest < 256 else piece >> 8


def stored_columns(handle: int, *, n: int, colors: bool) -> Columns:
    """Return the columns of `n` points that another process laid into a file."""
    if n == 0:
        return {name: np.empty(0) for name in "xyz"}
    mapped = mmap.mmap(handle, 0, access=mmap.ACCESS_READ)
    columns: dict[str, NDArray[Any]] = dict(_columns(mapped, "xyz", "<f8", n, at=0))
    if colors:
        wide = _columns(mapped, _COLORS, "<u2", n, at=24 * n)
        columns |= {name: column.view(np.uint8)[:n] for name, column in wide.items()}
    return columns


def _columns(mapped: mmap.mmap, names: Any, kind: str, n: int, *, at: int) -> Columns:
    """Return columns (n,) that lie one behind another from byte `at` on."""
    size = np.dtype(kind).itemsize * n
    return {
        name: np.frombuffer(mapped, kind, count=n, offset=at + index * size)
        for index, name in enumerate(names)
    }
