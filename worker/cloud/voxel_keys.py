"""Packed voxel keys: neighbours, coarser blocks and connected regions, by sorted keys and no dense grid.

A key holds the three cell indices in `BITS` bits each, x first, shifted so that none is negative. Sorted keys are
sorted by x, then y, then z, so that neighbours along z lie side by side.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from worker.cloud.types import Bools, Floats

Keys = NDArray[np.int64]

BITS = 21  #: of a signed cell index; 2^20 cells of 5 cm reach 52 km from the origin
_X, _Y = 1 << (2 * BITS), 1 << BITS
_MASK = _Y - 1
_HALF = 1 << (BITS - 1)
_WORD, _LAST = 6, 63  # bits of a place in a word of 64 voxels along z, and the last place


def packed(cells: NDArray[np.integer[Any]]) -> Keys:
    """Return the keys (N,) of cell indices (N, 3), of which each lies within ±2^20."""
    shifted = cells.astype(np.int64) + _HALF
    keys: Keys = (shifted[:, 0] << (2 * BITS)) | (shifted[:, 1] << BITS) | shifted[:, 2]
    return keys


def unpacked(keys: Keys) -> NDArray[np.int64]:
    """Return the cell indices (N, 3) of keys (N,)."""
    return np.stack([keys >> (2 * BITS), (keys >> BITS) & _MASK, keys & _MASK], axis=1) - _HALF


def centers(keys: Keys, size: float) -> Floats:
    """Return the middles (N, 3), metres, of voxels of `size` metres."""
    middles: Floats = (unpacked(keys) + 0.5).astype(np.float64) * size
    return middles


def blocks(keys: Keys, levels: int) -> Keys:
    """Return the keys (N,) of the blocks of 2^levels voxels along each axis that hold the voxels."""
    x, y, z = (
        keys >> (2 * BITS + levels),
        (keys >> (BITS + levels)) & (_MASK >> levels),
        (keys & _MASK) >> levels,
    )
    coarse: Keys = (x << (2 * BITS)) | (y << BITS) | z
    return coarse


def offsets(reach: int) -> Keys:
    """Return the ((2 reach + 1)^3,) differences of keys within `reach` voxels along each axis, ascending."""
    steps = range(-reach, reach + 1)
    return np.array([i * _X + j * _Y + k for i, j, k in itertools.product(steps, steps, steps)], np.int64)


def near(keys: Keys, others: Keys, reach: int = 1) -> Bools:
    """Tell (N,) which keys (N,) have one of `others` (M,), both ascending, within `reach` voxels along each axis.

    Columns of 64 voxels along z are words of bits, so that one look-up serves all voxels of a column.
    """
    if not len(others) or not len(keys):
        return np.zeros(len(keys), bool)
    columns, words = _columns(others, reach)
    column = keys >> _WORD
    first = np.r_[True, column[1:] != column[:-1]]
    wanted = column[first]
    steps = range(-reach, reach + 1)
    around = np.zeros(len(wanted), np.uint64)
    for i, j in itertools.product(steps, steps):
        row = rows_of(wanted + (i * _X + j * _Y) // (_LAST + 1), columns)
        around |= np.where(row >= 0, words[row], np.uint64(0))
    around = np.repeat(around, np.diff(np.r_[np.flatnonzero(first), len(keys)]))
    answer: Bools = ((around >> _bit(keys)) & np.uint64(1)).astype(bool)
    return answer


def _columns(keys: Keys, reach: int) -> tuple[Keys, NDArray[np.uint64]]:
    """Return the columns (C,) of 64 voxels that hold the keys, ascending, and their bits, grown by `reach` along z."""
    column, bits = keys >> _WORD, np.uint64(1) << _bit(keys)
    column, bits = _united(column, bits)
    for _ in range(reach):
        up = (bits >> np.uint64(_LAST)) > 0  # these reach into the column above, the others into that below
        down = (bits & np.uint64(1)) > 0
        grown = bits | (bits << np.uint64(1)) | (bits >> np.uint64(1))
        over = [np.ones(int(up.sum()), np.uint64), np.full(int(down.sum()), np.uint64(1) << np.uint64(_LAST))]
        beyond = [column[up] + 1, column[down] - 1]
        order = np.argsort(joined := np.concatenate([column, *beyond]), kind="stable")
        column, bits = _united(joined[order], np.concatenate([grown, *over])[order])
    return column, bits


def _united(column: Keys, bits: NDArray[np.uint64]) -> tuple[Keys, NDArray[np.uint64]]:
    """Join the bits of each column; columns ascend and may come several times."""
    starts = np.flatnonzero(np.r_[True, column[1:] != column[:-1]])
    return column[starts], np.bitwise_or.reduceat(bits, starts)


def _bit(keys: Keys) -> NDArray[np.uint64]:
    return (keys & _LAST).astype(np.uint64)


def rows_of(keys: Keys, among: Keys) -> NDArray[np.int64]:
    """Return (N,) the row of each key in `among` (M,), ascending; -1 where it is not there."""
    if not len(among):
        return np.full(len(keys), -1, np.int64)
    place = np.searchsorted(among, keys)
    place[place == len(among)] = 0
    rows: NDArray[np.int64] = np.where(among[place] == keys, place, -1)
    return rows


def union(keys: Keys, others: Keys) -> tuple[Keys, NDArray[np.intp], NDArray[np.intp]]:
    """Return the keys of both (N,) and (M,), each ascending and once, and the rows of the first and of the others."""
    both = np.concatenate([keys, others])
    order = np.argsort(both, kind="stable")  # merges two runs in one go
    both = both[order]
    first = np.ones(len(both), bool)
    first[1:] = both[1:] != both[:-1]
    rows = np.empty(len(both), np.intp)
    rows[order] = np.cumsum(first) - 1
    return both[first], rows[: len(keys)], rows[len(keys) :]


def dilated(keys: Keys, reach: int) -> Keys:
    """Return all keys within `reach` voxels of these, ascending, each once."""
    if not len(keys):
        return keys
    return np.unique((np.unique(keys)[:, None] + offsets(reach)[None, :]).ravel())


def regions(keys: Keys) -> tuple[int, NDArray[np.int64]]:
    """Return how many 26-connected regions the voxels (N,), ascending and each once, make, and (N,) whose each is."""
    if not len(keys):
        return 0, np.empty(0, np.int64)
    links = [rows_of(keys + offset, keys) for offset in offsets(1)[14:]]  # the other half is the same again
    rows = np.concatenate([np.flatnonzero(link >= 0) for link in links])
    columns = np.concatenate([link[link >= 0] for link in links])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(keys), len(keys)))
    count, labels = connected_components(graph, directed=False)
    return int(count), labels.astype(np.int64)
