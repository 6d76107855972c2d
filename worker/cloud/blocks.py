"""Blocks: a large cloud cut into pieces that are worked at one by one, each with what lies around it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.intp]

_SLAB = 10  # blocks that are taken out of the whole cloud together, so that it is not looked through for each
_LOOKED_AT = 100_000  # points that tell where slabs begin


@dataclass(frozen=True, kw_only=True, slots=True)
class Block:
    """Points that lie together, and those in reach of them."""

    rows: Rows  #: (K,) of the cloud: its own and those around
    own: Rows  #: (J,) places in `rows` of its own points; each point of the cloud is some block's own


def blocks_of(points: NDArray[Any], *, most: int, reach: float) -> Iterator[Block]:
    """Cut points (N, 3), metres, into blocks of at most about `most` own points, with all within `reach` metres.

    A cloud of no more is one block. Slabs across x come first, so that beside a slab no more than a few bytes a point
    of the cloud are held; each slab is then halved across its longest side until its parts are small.
    """
    if len(points) <= most:
        everything = np.arange(len(points))
        yield Block(rows=everything, own=everything)
        return
    along = points[:, 0]
    for lower, upper in _slabs(along, most * _SLAB):
        rows = np.flatnonzero((along >= lower - reach) & (along < upper + reach))
        here = points[rows]
        own = np.flatnonzero((here[:, 0] >= lower) & (here[:, 0] < upper))
        if not len(own):
            continue
        for block in _halved(here, own, np.arange(len(rows)), most, reach):
            yield Block(rows=rows[block.rows], own=block.own)


def _slabs(along: NDArray[Any], most: int) -> Iterator[tuple[float, float]]:
    """Yield where slabs of about `most` points begin and end; the first and the last are open."""
    looked_at = np.sort(along[:: max(len(along) // _LOOKED_AT, 1)])
    count = -(-len(along) // most)
    cuts = looked_at[np.arange(1, count) * len(looked_at) // count]
    edges = [-np.inf, *np.unique(cuts).tolist(), np.inf]
    yield from pairwise(edges)


def _halved(points: NDArray[Any], own: Rows, around: Rows, most: int, reach: float) -> Iterator[Block]:
    """Yield the blocks of some points (rows `own`), of which `around` are those in reach, themselves among them."""
    spans = [float(np.ptp(points[own, axis])) for axis in range(3)] if len(own) > most else [0.0]
    if not any(spans):  # few enough, or all in one place
        yield Block(rows=around, own=np.searchsorted(around, own))
        return
    axis = int(np.argmax(spans))
    along = points[own, axis]
    middle = np.median(along)
    left = along < middle if middle > along.min() else along <= middle  # both halves have points
    beside = points[around, axis]
    yield from _halved(points, own[left], around[beside <= middle + reach], most, reach)
    yield from _halved(points, own[~left], around[beside >= middle - reach], most, reach)
