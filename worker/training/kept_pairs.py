"""Pairs whose descriptors and statistics are computed once: all that a head needs to be trained on its own.

Encoding a tile is nearly all of the work of a training step. With a frozen encoder it is done once for every
observation, and a head then sees a thousand times as many pairs in the same time. Nothing is augmented: the
observations differ as visits do, and a share of the still pairs by noise and lost points where that is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from worker.cloud.types import Points
from worker.detectors.trainable import CHANGED, DIFFERENT, UNCHANGED, TrainableNetwork
from worker.progress import Progress, no_progress
from worker.training.dataset import TileSet
from worker.training.pairs import PairSettings, changed, disturbed, some_disturbance

#: Shares of the unchanged pairs by what they are of: of those of two visits, and of those that are still, which are
#: as many of them as of the changed ones. Otherwise that a pair is still would say what it is.
OF_VISITS = {"revisit": 0.625, "beside": 0.375}
STILL = {"untouched": 0.75, "stored": 0.25}
NOISY = " noisy"  #: behind the kind of a pair that is still but for noise
DIFFERENT_EACH = 2  #: pairs of different tiles that are kept for each tile


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PooledPairs:
    """Pairs of one kind, in one class."""

    label: int
    reference: NDArray[np.int64]  #: (n,) rows of the descriptors
    current: NDArray[np.int64]  #: (n,)
    statistics: NDArray[np.float32]  #: (n, S)
    both_ways: bool  #: visits have no order; a stored map and what was made of it have


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Drawn:
    """Pairs as a head takes them."""

    reference: Tensor  #: (n, D)
    current: Tensor  #: (n, D)
    statistics: Tensor  #: (n, S)
    labels: Tensor  #: (n,) int64


class PairPool:
    """All pairs of a training set, by kind; draws any number of them in the classes' shares."""

    def __init__(
        self,
        kind: TrainableNetwork[Any],
        descriptors: Tensor,
        kinds: dict[str, PooledPairs],
        settings: PairSettings,
    ) -> None:
        self._kind = kind
        self._descriptors = descriptors
        self.kinds = {name: pairs for name, pairs in kinds.items() if len(pairs.reference)}
        self._shares = _shares(self.kinds, settings)

    def draw(self, count: int, rng: np.random.Generator) -> Drawn:
        """Draw about `count` pairs in random order, the same for the same generator."""
        parts = [
            self._picked(self.kinds[name], round(count * share), rng) for name, share in self._shares.items()
        ]
        reference, current, statistics, labels = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        order = rng.permutation(len(labels))
        return Drawn(
            reference=self._descriptors[torch.from_numpy(reference[order])],
            current=self._descriptors[torch.from_numpy(current[order])],
            statistics=torch.from_numpy(statistics[order]),
            labels=torch.from_numpy(labels[order]),
        )

    def _picked(
        self, pairs: PooledPairs, count: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.generic], ...]:
        """Draw `count` of them: rows, rows, statistics, labels; each twice only where there are too few."""
        chosen = rng.choice(len(pairs.reference), count, replace=count > len(pairs.reference))
        reference, current = pairs.reference[chosen], pairs.current[chosen]
        statistics = pairs.statistics[chosen]
        if pairs.both_ways:
            turned = rng.random(count) < 0.5
            reference, current = np.where(turned, current, reference), np.where(turned, reference, current)
            statistics = np.where(turned[:, None], self._kind.swapped(statistics), statistics)
        return reference, current, statistics, np.full(count, pairs.label, np.int64)


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
    "untouched noisy": (UNCHANGED, False),
    "stored noisy": (UNCHANGED, False),
    "whole": (CHANGED, True),
    "rebuilt": (CHANGED, False),
    "rebuilt noisy": (CHANGED, False),
    "synthetic": (CHANGED, True),
    "different": (DIFFERENT, True),
}


def keep_pairs(
    kind: TrainableNetwork[Any],
    network: nn.Module,
    tiles: TileSet,
    settings: PairSettings,
    *,
    seed: int,
    progress: Progress = no_progress,
) -> PairPool:
    """Encode every observation of the set and compare those that make a pair. Raises ValueError without two tiles."""
    if len(tiles) < 2:
        raise ValueError(f"pairs need at least two tiles, there are {len(tiles)}")
    gathered = _gathered(tiles, settings, np.random.default_rng((seed, 4)))
    descriptors, clouds = kind.encode(network, gathered.clouds, progress)
    kinds = {name: _compared(kind, name, pairs, clouds) for name, pairs in gathered.pairs.items()}
    progress("encode", 1.0)
    return PairPool(kind, descriptors, kinds, settings)


def _gathered(tiles: TileSet, settings: PairSettings, rng: np.random.Generator) -> _Gathering:
    gathering = _Gathering()

    def still(kind: str, reference: int, current: int) -> None:
        """Keep a still pair, and the same with noise."""
        gathering.pair(kind, reference, current)
        if settings.noisy_share:
            cloud = disturbed(gathering.clouds[current], some_disturbance(settings, rng), rng)
            gathering.pair(kind + NOISY, reference, gathering.cloud(cloud))

    synthetic = _synthetic_share(settings) > 0 or not any(one.changed for one in tiles.observations)
    first = [gathering.cloud(points) for points in tiles.points_a]
    second = [gathering.cloud(points) if len(points) else None for points in tiles.points_b]
    for tile, (a, b) in enumerate(zip(first, second, strict=True)):
        still("stored", a, a)
        if b is not None:
            gathering.pair("revisit", a, b)
        if synthetic:
            before = tiles.points_a[tile] if b is None else tiles.points_b[tile]
            gathering.pair("synthetic", a, gathering.cloud(changed(before, settings, tiles.half, rng)))
    for observation in tiles.observations:
        here, a, b = gathering.cloud(observation.points), first[observation.tile], second[observation.tile]
        if observation.rebuilt:
            still("rebuilt" if observation.changed else "untouched", a, here)
            continue
        kind = "whole" if observation.changed else "beside"
        gathering.pair(kind, a, here)
        if b is not None:  # another honest observation of what was there before
            gathering.pair(kind, b, here)
    for i, j in _apart(tiles, settings.min_separation, rng):
        gathering.pair("different", first[i], first[j])
    return gathering


def _apart(tiles: TileSet, min_separation: float, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """Return some pairs of tiles of two buildings, or that far apart in one."""
    for i in range(len(tiles)):
        for j in rng.integers(len(tiles), size=DIFFERENT_EACH).tolist():
            away = float(np.linalg.norm(tiles.centres[i] - tiles.centres[j]))
            if tiles.buildings[i] != tiles.buildings[j] or away >= min_separation:
                yield i, j


def _compared(
    kind: TrainableNetwork[Any], name: str, pairs: Sequence[tuple[int, int]], clouds: Sequence[Tensor]
) -> PooledPairs:
    rows = np.array(pairs, np.int64).reshape(-1, 2)
    references, currents = ([clouds[row] for row in column] for column in rows.T)
    label, both_ways = KINDS[name]
    return PooledPairs(
        label=label,
        reference=rows[:, 0],
        current=rows[:, 1],
        statistics=kind.compare(references, currents),
        both_ways=both_ways,
    )


def _shares(kinds: dict[str, PooledPairs], settings: PairSettings) -> dict[str, float]:
    """Return the shares of all pairs, by kind; what a class lacks goes to its other kinds."""
    visits = max(1 - settings.rebuilt_share, 0.0)
    within = {
        **{kind: visits * share for kind, share in OF_VISITS.items()},
        **{kind: settings.rebuilt_share * share for kind, share in STILL.items()},
        "whole": settings.edited_share,
        "rebuilt": settings.rebuilt_share,
        "synthetic": _synthetic_share(settings) if {"whole", "rebuilt"} & kinds.keys() else 1.0,
        "different": 1.0,
    }
    for kind in ("untouched", "stored", "rebuilt"):
        within[kind + NOISY] = settings.noisy_share * within[kind]
        within[kind] *= 1 - settings.noisy_share
    there = {name: within[name] for name in kinds if within[name] > 0}
    total = {
        label: sum(share for name, share in there.items() if KINDS[name][0] == label)
        for label in (UNCHANGED, CHANGED, DIFFERENT)
    }
    return {
        name: settings.shares[KINDS[name][0]] * share / total[KINDS[name][0]] for name, share in there.items()
    }


def _synthetic_share(settings: PairSettings) -> float:
    """Return the share of changed pairs that are synthetic changes of a tile, clear of rounding."""
    return max(round(1 - settings.edited_share - settings.rebuilt_share, 9), 0.0)
