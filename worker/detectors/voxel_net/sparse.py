"""Sparse convolutions in plain torch: a table of neighbours, a gather and one matrix product.

The idea is that of submanifold sparse convolutional networks (Graham, Engelcke and van der Maaten, CVPR 2018): only
occupied cells have features, and only they get some.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from worker.cloud.voxel_keys import BITS, Keys, blocks, offsets, rows_of

NEIGHBOURS = 27
CHILDREN = 8


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Level:
    """The cells of one size, and how they hang together with those of half the size."""

    neighbours: Tensor  #: (N, 27) int64, row of each neighbour; N where there is none
    children: Tensor  #: (N, 8) int64, row of each child among the finer cells (M); M where there is none
    parent: Tensor  #: (M,) int64, row of each finer cell's parent
    child: Tensor  #: (M,) int64, which child of its parent a finer cell is

    def to(self, device: torch.device) -> Level:
        """Return the same on a device."""
        return Level(
            neighbours=self.neighbours.to(device),
            children=self.children.to(device),
            parent=self.parent.to(device),
            child=self.child.to(device),
        )


def pyramid(keys: Keys, levels: int) -> list[Level]:
    """Return the cells of twice, four times, ... the size of the voxels (N,), ascending keys."""
    finer, made = keys, []
    for _ in range(levels):
        parents = blocks(finer, 1)
        cells, parent = np.unique(parents, return_inverse=True)
        child = _child_of(finer)
        children = np.full((len(cells), CHILDREN), len(finer), np.int64)
        children[parent, child] = np.arange(len(finer))
        made.append(
            Level(
                neighbours=torch.from_numpy(_neighbours(cells)),
                children=torch.from_numpy(children),
                parent=torch.from_numpy(parent.astype(np.int64)),
                child=torch.from_numpy(child),
            )
        )
        finer = cells
    return made


def side_by_side(pyramids: Sequence[Sequence[Level]]) -> list[Level]:
    """Return the pyramid over the voxels of several, one behind the other, of which no cell has a neighbour in another."""
    if len(pyramids) == 1:
        return list(pyramids[0])
    return [_joined(levels) for levels in zip(*pyramids, strict=True)]


def _joined(levels: Sequence[Level]) -> Level:
    cells = [len(level.neighbours) for level in levels]
    finer = [len(level.parent) for level in levels]
    first_cell, first_finer = list(accumulate(cells, initial=0)), list(accumulate(finer, initial=0))
    return Level(
        neighbours=_stacked([level.neighbours for level in levels], cells, first_cell),
        children=_stacked([level.children for level in levels], finer, first_finer),
        parent=torch.cat([level.parent + begin for level, begin in zip(levels, first_cell, strict=False)]),
        child=torch.cat([level.child for level in levels]),
    )


def _stacked(tables: Sequence[Tensor], counts: Sequence[int], begins: Sequence[int]) -> Tensor:
    """Stack tables of rows, each of which has its count for none, so that each row is found behind those before."""
    none = begins[-1]
    return torch.cat(
        [
            torch.where(table == count, none, table + begin)
            for table, count, begin in zip(tables, counts, begins, strict=False)
        ]
    )


def _child_of(keys: Keys) -> NDArray[np.int64]:
    """Return (N,) which of the eight children of its parent a cell is: the lowest bit of x, y and z."""
    which: NDArray[np.int64] = ((keys >> (2 * BITS)) & 1) * 4 + ((keys >> BITS) & 1) * 2 + (keys & 1)
    return which


def _neighbours(cells: Keys) -> NDArray[np.int64]:
    """Return (N, 27) the rows of the cells around each, itself in the middle; N where there is none."""
    count, steps = len(cells), offsets(1)
    table = np.full((count, NEIGHBOURS), count, np.int64)
    table[:, NEIGHBOURS // 2] = np.arange(count)
    for column in range(NEIGHBOURS // 2):
        row = rows_of(cells + steps[column], cells)
        there = np.flatnonzero(row >= 0)
        table[there, column] = row[there]
        table[row[there], NEIGHBOURS - 1 - column] = there
    return table


class _Gathered(torch.autograd.Function):
    """Multiply each cell's neighbourhood by one matrix; the gradient is a gather as well.

    Where b is the neighbour of a in one direction, a is that of b in the opposite one: the table serves both ways,
    with the matrix turned around.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, table: Tensor) -> Tensor:
        ctx.save_for_backward(features, weight, table)
        return _columns(features, table) @ weight

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:
        (grad,) = grads
        features, weight, table = ctx.saved_tensors
        to_weight = _columns(features, table).T @ grad
        turned = weight.view(NEIGHBOURS, features.shape[1], -1).flip(0).transpose(1, 2)
        to_features = _columns(grad.contiguous(), table) @ turned.reshape(-1, features.shape[1])
        return to_features, to_weight, None


def _columns(features: Tensor, table: Tensor) -> Tensor:
    """Return (N, K C) the features (M, C) that a table (N, K) names; zeros for row M."""
    padded = torch.cat([features, features.new_zeros(1, features.shape[1])])
    return padded.index_select(0, table.reshape(-1)).view(len(table), -1)


class Convolution(nn.Module):
    """A submanifold convolution over 3 x 3 x 3 cells."""

    def __init__(self, inner: int, outer: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(NEIGHBOURS * inner, outer))
        nn.init.normal_(self.weight, std=(2 / (9 * inner)) ** 0.5)  # about nine of the 27 are occupied

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Map (N, inner) to (N, outer)."""
        product: Tensor = _Gathered.apply(features, self.weight, level.neighbours)  # type: ignore[no-untyped-call]
        return product


class Merge(nn.Module):
    """Gather up to eight children into their cell, each by weights of its own."""

    def __init__(self, inner: int, outer: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(CHILDREN * inner, outer))
        nn.init.normal_(self.weight, std=(2 / (4 * inner)) ** 0.5)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Map the finer cells' (M, inner) to (N, outer)."""
        return _columns(features, level.children) @ self.weight


class Split(nn.Module):
    """Hand each cell's features to its children, each by weights of its own."""

    def __init__(self, inner: int, outer: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(inner, CHILDREN * outer))
        nn.init.normal_(self.weight, std=(2 / inner) ** 0.5)
        self._outer = outer

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Map (N, inner) to the finer cells' (M, outer)."""
        all_children = (features @ self.weight).view(-1, self._outer)
        return all_children.index_select(0, level.parent * CHILDREN + level.child)
