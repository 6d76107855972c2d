"""How a Siamese network is trained: its batches, its loss, its head's first weights (paper, Sections 3.6 and 3.7)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from worker.cloud.patches import Patch, patch
from worker.cloud.types import Points
from worker.detectors.siamese.chamfer import COUNTS, STATISTICS, chamfer_statistics, swapped
from worker.detectors.siamese.head import PairHead
from worker.detectors.trainable import DIFFERENT, Pair
from worker.progress import Progress

CLOUDS_PER_REPORT = 32
ALPHA = (0.25, 0.35, 0.40)  #: against the classes' shares of 50, 35 and 15%
GAMMA = 2.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """What every network of this kind is given of B examples; each adds the clouds as its encoder takes them."""

    chamfer_points: (
        Points  #: (Q, 3) of 2 B clouds, references first, tile-centre frame: what the Chamfer branch compares
    )
    chamfer_sizes: list[int]  #: of these clouds
    labels: NDArray[np.int64]  #: (B,)


B = TypeVar("B", bound=Batch)
Encoder = Callable[[Patch], Tensor]  #: a patch to its descriptor (D,), as in use


@dataclass(frozen=True, kw_only=True, slots=True)
class SiameseTraining(ABC, Generic[B]):
    """What TrainableNetwork (worker.detectors.trainable) asks and all such networks do alike.

    The fields are those of SiameseSettings. The module has `encoder.` before the names of its encoder's weights.
    """

    patch_points: int
    chamfer_points: int | None
    seed: int
    counts: bool = False

    @abstractmethod
    def head(self, module: nn.Module) -> PairHead:
        """Return the head of a network that `build` made."""

    @abstractmethod
    def descriptors(self, module: nn.Module, batch: B) -> Tensor:
        """Encode the clouds of a batch as a training step does: (2 B, D)."""

    @abstractmethod
    def encoder(self, module: nn.Module) -> Encoder:
        """Return what encodes a patch in use."""

    def class_loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        """Return the focal loss of logits (n, 3)."""
        return focal_loss(logits, labels)

    def start_from(self, module: nn.Module, weights: Mapping[str, Tensor], *, fresh_head: bool) -> None:
        """Take over all weights, or with `fresh_head` those of the encoder. Raises ValueError for another network's."""
        part, inner = (module.get_submodule("encoder"), "encoder.") if fresh_head else (module, "")
        taken = {name.removeprefix(inner): value for name, value in weights.items() if name.startswith(inner)}
        try:
            part.load_state_dict(taken)
        except RuntimeError as unsound:
            raise ValueError(f"what it starts from is another network: {unsound}") from unsound

    @torch.no_grad()
    def initialize_from_data(self, module: nn.Module, batches: Iterable[B]) -> None:
        """Initialise the head by pairs of one place, whose distances are the fine ones."""
        sides, statistics = [], []
        for batch in batches:
            same_place = torch.from_numpy(batch.labels) != DIFFERENT
            sides.append([side[same_place] for side in self.descriptors(module, batch).chunk(2)])
            statistics.append(self._statistics(*compared(batch, device_of(module)))[same_place])
        reference, current = (torch.cat(side) for side in zip(*sides, strict=True))
        self.begin_head(module, reference, current, torch.cat(statistics))

    def begin_head(self, module: nn.Module, reference: Tensor, current: Tensor, statistics: Tensor) -> None:
        """Initialise the head from descriptors (n, D) of both sides and statistics (n, 8 or 16) of n pairs."""
        device = device_of(module)
        self.head(module).initialize_from_data(
            reference.to(device), current.to(device), statistics.to(device)
        )

    def encode(
        self, module: nn.Module, clouds: Sequence[Points], progress: Progress
    ) -> tuple[Tensor, list[Tensor]]:
        """Return descriptors (n, D), and of each cloud what the Chamfer branch sees, as in use."""
        encoder = self.encoder(module)
        descriptors, samples = torch.empty(len(clouds), self.head(module).descriptor), []
        for row, points in enumerate(clouds):
            if row % CLOUDS_PER_REPORT == 0:
                progress("encode", row / len(clouds))
            prepared = patch(points, size=self.patch_points, seed=self.seed)
            descriptors[row] = encoder(prepared).cpu()
            sample = self._sample(prepared.distinct, np.random.default_rng((self.seed, 5, row)))
            samples.append(torch.from_numpy(sample))
        return descriptors, samples

    def compare(self, references: Sequence[Tensor], currents: Sequence[Tensor]) -> NDArray[np.float32]:
        """Return the statistics (n, 8 or 16)."""
        if not references:
            return np.zeros((0, STATISTICS + COUNTS * self.counts), np.float32)
        statistics: NDArray[np.float32] = self._statistics(references, currents).numpy()
        return statistics

    def swapped(self, statistics: NDArray[np.float32]) -> NDArray[np.float32]:
        """Exchange what is of one direction for what is of the other, (n, S) -> (n, S)."""
        exchanged: NDArray[np.float32] = swapped(torch.from_numpy(statistics)).numpy()
        return exchanged

    def _statistics(self, references: Sequence[Tensor], currents: Sequence[Tensor]) -> Tensor:
        return chamfer_statistics(references, currents, counts=self.counts)

    def _samples(self, clouds: Sequence[Points], rng: np.random.Generator) -> list[Points]:
        """Return what the Chamfer branch sees of each."""
        return [self._sample(cloud, rng) for cloud in clouds]

    def _sample(self, distinct: Points, rng: np.random.Generator) -> Points:
        """Return all points, or a new draw without replacement from the padded patch (paper, Section 3.6.3)."""
        if self.chamfer_points is None:
            return distinct
        places = rng.choice(self.patch_points, self.chamfer_points, replace=False)
        return distinct[places % len(distinct)]


def both_sides(pairs: Sequence[Pair]) -> list[Points]:
    """Return the clouds of a batch, references before currents."""
    return [pair.reference for pair in pairs] + [pair.current for pair in pairs]


def labels_of(pairs: Sequence[Pair]) -> NDArray[np.int64]:
    """Return (B,)"""
    return np.array([pair.label for pair in pairs], dtype=np.int64)


def compared(batch: Batch, device: torch.device) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Return what the Chamfer branch compares, B references and B currents."""
    clouds = torch.split(torch.from_numpy(batch.chamfer_points).to(device), batch.chamfer_sizes)
    half = len(clouds) // 2
    return clouds[:half], clouds[half:]


def device_of(module: nn.Module) -> torch.device:
    """Return where the weights lie."""
    return next(module.parameters()).device


def focal_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Return mean of -alpha_c (1 - p_c)^2 log p_c over (B, 3) logits, c the true class of each of (B,) labels."""
    log_p = logits.float().log_softmax(dim=1).gather(1, labels[:, None])[:, 0]  # (B,)
    alpha = torch.tensor(ALPHA, device=logits.device)[labels]
    return -(alpha * (1 - log_p.exp()) ** GAMMA * log_p).mean()
