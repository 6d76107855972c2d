"""Pairs whose descriptors and Chamfer statistics are computed once: all that a head needs to be trained on its own.

Encoding a tile is nearly all of the work of a training step. With a frozen encoder it is done once for every look,
and a head then sees a thousand times as many pairs in the same time. Nothing is augmented: the looks differ as visits do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worker.cloud.patches import patch
from worker.cloud.types import Points
from worker.detectors.spicd_net.chamfer import STATISTICS, chamfer_statistics
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.network import DESCRIPTOR, PointEncoder
from worker.progress import Progress, no_progress
from worker.training.dataset import TileSet
from worker.training.pairs import CHANGED, DIFFERENT, UNCHANGED, PairSettings, changed

#: Shares of the unchanged pairs by what they are of.
UNCHANGED_SHARES = {"revisit": 0.50, "beside": 0.30, "untouched": 0.15, "stored": 0.05}
DIFFERENT_EACH = 2  #: pairs of different tiles that are kept for each tile
TILES_PER_REPORT = 32


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class KeptPairs:
    """Pairs of one kind, in one class."""

    label: int
    reference: NDArray[np.int64]  #: (n,) rows of the descriptors
    current: NDArray[np.int64]  #: (n,)
    statistics: NDArray[np.float32]  #: (n, 8)
    both_ways: bool  #: visits have no order; a stored map and what was made of it have


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Drawn:
    """Pairs as a head takes them."""

    reference: Tensor  #: (n, 1024)
    current: Tensor  #: (n, 1024)
    statistics: Tensor  #: (n, 8)
    labels: Tensor  #: (n,) int64


class PairPool:
    """All pairs of a training set, by kind; draws any number of them in the classes' shares."""

    def __init__(self, descriptors: Tensor, kinds: dict[str, KeptPairs], settings: PairSettings) -> None:
        self._descriptors = descriptors
        self.kinds = {name: pairs for name, pairs in kinds.items() if len(pairs.reference)}
        self._shares = _shares(self.kinds, settings)

    def draw(self, count: int, rng: np.random.Generator) -> Drawn:
        """About `count` pairs in random order, the same for the same generator."""
        parts = [_picked(self.kinds[name], round(count * share), rng) for name, share in self._shares.items()]
        reference, current, statistics, labels = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = rng.permutation(len(labels))
        return Drawn(
            reference=self._descriptors[torch.from_numpy(reference[order])],
            current=self._descriptors[torch.from_numpy(current[order])],
            statistics=torch.from_numpy(statistics[order]),
            labels=torch.from_numpy(labels[order]),
        )


@dataclass(slots=True)
class _Gathering:
    """Clouds and pairs of them, before anything is encoded."""

    clouds: list[Points] = field(default_factory=list)
    pairs: dict[str, list[tuple[int, int]]] = field(default_factory=dict)

    def cloud(self, points: Points) -> int:
        self.clouds.append(points)
        return len(self.clouds) - 1

    def pair(self, kind: str, reference: int, current: int) -> None:
        self.pairs.setdefault(kind, []).append((reference, current))


#: Kinds of pairs: class, and whether they are drawn both ways round.
KINDS: dict[str, tuple[int, bool]] = {
    "revisit": (UNCHANGED, True),
    "beside": (UNCHANGED, True),
    "untouched": (UNCHANGED, False),
    "stored": (UNCHANGED, False),
    "whole": (CHANGED, True),
    "rebuilt": (CHANGED, False),
    "synthetic": (CHANGED, True),
    "different": (DIFFERENT, True),
}


def keep_pairs(
    encoder: PointEncoder,
    tiles: TileSet,
    settings: PairSettings,
    *,
    seed: int,
    progress: Progress = no_progress,
) -> PairPool:
    """Encode every look of the set and compare those that make a pair. Raises ValueError without two tiles."""
    if len(tiles) < 2:
        raise ValueError(f"pairs need at least two tiles, there are {len(tiles)}")
    gathered = _gathered(tiles, settings, np.random.default_rng((seed, 4)))
    device = next(encoder.parameters()).device
    patches = [patch(points, size=settings.patch_points, seed=seed) for points in gathered.clouds]
    frozen = FrozenEncoder(encoder)
    descriptors = torch.empty(len(patches), DESCRIPTOR)
    for row, each in enumerate(patches):
        if row % TILES_PER_REPORT == 0:
            progress("encode", row / len(patches))
        distinct, centroid = (torch.from_numpy(part).to(device) for part in (each.distinct, each.centroid))
        descriptors[row] = frozen(distinct, centroid).cpu()
    clouds = [
        _compared(each.distinct, settings, np.random.default_rng((seed, 5, row)))
        for row, each in enumerate(patches)
    ]
    kinds = {kind: _kept(kind, pairs, clouds) for kind, pairs in gathered.pairs.items()}
    progress("encode", 1.0)
    return PairPool(descriptors, kinds, settings)


def _gathered(tiles: TileSet, settings: PairSettings, rng: np.random.Generator) -> _Gathering:
    found = _Gathering()
    half = (np.asarray(tiles.tile_size) / 2).astype(np.float32)
    first = [found.cloud(points) for points in tiles.points_a]
    second = [found.cloud(points) if len(points) else None for points in tiles.points_b]
    for tile, (a, b) in enumerate(zip(first, second, strict=True)):
        found.pair("stored", a, a)
        if b is not None:
            found.pair("revisit", a, b)
        after = changed(tiles.points_a[tile] if b is None else tiles.points_b[tile], settings, half, rng)
        found.pair("synthetic", a, found.cloud(after))
    for look in tiles.looks:
        here, a, b = found.cloud(look.points), first[look.tile], second[look.tile]
        if look.rebuilt:
            found.pair("rebuilt" if look.changed else "untouched", a, here)
            continue
        kind = "whole" if look.changed else "beside"
        found.pair(kind, a, here)
        if b is not None:  # another honest look at what was there before
            found.pair(kind, b, here)
    for i, j in _apart(tiles, settings.min_separation, rng):
        found.pair("different", first[i], first[j])
    return found


def _apart(tiles: TileSet, min_separation: float, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """Some pairs of tiles of two buildings, or that far apart in one."""
    for i in range(len(tiles)):
        for j in rng.integers(len(tiles), size=DIFFERENT_EACH).tolist():
            away = float(np.linalg.norm(tiles.centres[i] - tiles.centres[j]))
            if tiles.buildings[i] != tiles.buildings[j] or away >= min_separation:
                yield i, j


def _compared(distinct: Points, settings: PairSettings, rng: np.random.Generator) -> Tensor:
    """What the Chamfer branch sees of a patch, as in use."""
    if settings.chamfer_points is None:
        return torch.from_numpy(distinct)
    places = rng.choice(settings.patch_points, settings.chamfer_points, replace=False)
    return torch.from_numpy(distinct[places % len(distinct)])


def _kept(kind: str, pairs: Sequence[tuple[int, int]], clouds: Sequence[Tensor]) -> KeptPairs:
    rows = np.array(pairs, np.int64).reshape(-1, 2)
    statistics = np.zeros((len(rows), STATISTICS), np.float32)
    if kind != "stored":
        statistics[:] = chamfer_statistics(
            [clouds[row] for row in rows[:, 0]], [clouds[row] for row in rows[:, 1]]
        ).numpy()
    label, both_ways = KINDS[kind]
    return KeptPairs(
        label=label, reference=rows[:, 0], current=rows[:, 1], statistics=statistics, both_ways=both_ways
    )


def _shares(kinds: dict[str, KeptPairs], settings: PairSettings) -> dict[str, float]:
    """Of all pairs, by kind; what a class lacks goes to its other kinds."""
    synthetic = 1 - settings.edited_share - settings.rebuilt_share
    if not {"whole", "rebuilt"} & kinds.keys():
        synthetic = 1.0
    within = {
        **UNCHANGED_SHARES,
        "whole": settings.edited_share,
        "rebuilt": settings.rebuilt_share,
        "synthetic": synthetic,
        "different": 1.0,
    }
    there = {name: within[name] for name in kinds if within[name] > 0}
    total = {
        label: sum(share for name, share in there.items() if KINDS[name][0] == label)
        for label in (UNCHANGED, CHANGED, DIFFERENT)
    }
    return {
        name: settings.shares[KINDS[name][0]] * share / total[KINDS[name][0]] for name, share in there.items()
    }


def _picked(pairs: KeptPairs, count: int, rng: np.random.Generator) -> tuple[NDArray[np.generic], ...]:
    """`count` of them: rows, rows, statistics, labels; each twice only where there are too few."""
    chosen = rng.choice(len(pairs.reference), count, replace=count > len(pairs.reference))
    reference, current, statistics = (
        each[chosen] for each in (pairs.reference, pairs.current, pairs.statistics)
    )
    if pairs.both_ways:
        turned = rng.random(count) < 0.5
        reference, current = np.where(turned, current, reference), np.where(turned, reference, current)
        statistics = np.where(turned[:, None], np.roll(statistics, STATISTICS // 2, axis=1), statistics)
    return reference, current, statistics, np.full(count, pairs.label, np.int64)
