"""How SPICD-Net is trained: its batches, its loss, its head's first weights (paper, Sections 3.6 and 3.7)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from worker.cloud.patches import patch
from worker.cloud.types import Points
from worker.detectors.spicd_net.chamfer import chamfer_statistics, swapped
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.layers import PooledLinear
from worker.detectors.spicd_net.network import DESCRIPTOR, PairHead, PairOutput, SpicdNetwork
from worker.detectors.trainable import DIFFERENT, Pair
from worker.progress import Progress

CLOUDS_PER_REPORT = 32
ALPHA = (0.25, 0.35, 0.40)  #: against the classes' shares of 50, 35 and 15%
GAMMA = 2.0
ORTHOGONALITY = 0.001


@dataclass(frozen=True, slots=True)
class Batch:
    """B examples as the network takes them."""

    points: Points  #: (P, 3) float32: 2 B clouds end to end, references first, each with its centroid at 0
    sizes: list[int]  #: of the clouds
    chamfer_points: Points  #: (Q, 3) in the same order, tile-centre frame: what the Chamfer branch compares
    chamfer_sizes: list[int]
    labels: NDArray[np.int64]  #: (B,)


@dataclass(frozen=True, kw_only=True, slots=True)
class SpicdNetTraining:
    """TrainableNetwork (worker.detectors.trainable); the fields are those of SpicdNetSettings."""

    title: ClassVar[str] = "SPICD-Net"

    patch_points: int
    chamfer_points: int | None
    seed: int
    counts: bool = False

    def build(self, *, coarse_search: bool = False) -> SpicdNetwork:
        """Return the network before training; a coarse search is that of PooledLinear."""
        network = SpicdNetwork(counts=self.counts)
        for module in network.modules():
            if isinstance(module, PooledLinear):
                module.coarse_search = coarse_search
        return network

    def collate(self, pairs: Sequence[Pair], rng: np.random.Generator) -> Batch:
        """Put references before currents, every cloud about its centroid."""
        clouds = [pair.reference for pair in pairs] + [pair.current for pair in pairs]
        compared = [self._compared(cloud, rng) for cloud in clouds]
        return Batch(
            np.concatenate([cloud - cloud.mean(axis=0) for cloud in clouds]),
            [len(cloud) for cloud in clouds],
            np.concatenate(compared),
            [len(cloud) for cloud in compared],
            np.array([pair.label for pair in pairs], dtype=np.int64),
        )

    def answer(self, module: nn.Module, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return logits (B, 3), and focal loss with the T-Nets' orthogonality."""
        device = _device(module)
        points, compared, labels = (
            torch.from_numpy(array).to(device) for array in (batch.points, batch.chamfer_points, batch.labels)
        )
        output: PairOutput = module(points, batch.sizes, compared, batch.chamfer_sizes)
        return output.logits, total_loss(output.logits, labels, output.transforms)

    def class_loss(self, logits: Tensor, labels: Tensor) -> Tensor:
        """Return the focal loss of logits (n, 3)."""
        return focal_loss(logits, labels)

    def start_from(self, module: nn.Module, weights: Mapping[str, Tensor], *, fresh_head: bool) -> None:
        """Take over all weights, or with `fresh_head` those of the encoder."""
        if not fresh_head:
            module.load_state_dict(weights)
            return
        inner = "encoder."
        _network(module).encoder.load_state_dict(
            {name.removeprefix(inner): value for name, value in weights.items() if name.startswith(inner)}
        )

    @torch.no_grad()
    def initialize_from_data(self, module: nn.Module, batches: Iterable[Batch]) -> None:
        """Initialise the head by pairs of one place, whose distances are the fine ones."""
        network, device = _network(module), _device(module)
        sides, statistics = [], []
        for batch in batches:
            points, compared = (
                torch.from_numpy(array).to(device) for array in (batch.points, batch.chamfer_points)
            )
            same_place = torch.from_numpy(batch.labels) != DIFFERENT
            sides.append([side[same_place] for side in network.encoder(points, batch.sizes)[0].chunk(2)])
            clouds = torch.split(compared, batch.chamfer_sizes)
            half = len(clouds) // 2
            compared_here = chamfer_statistics(clouds[:half], clouds[half:], counts=self.counts)
            statistics.append(compared_here[same_place])
        reference, current = (torch.cat(side) for side in zip(*sides, strict=True))
        network.head.initialize_from_data(reference, current, torch.cat(statistics))

    def head(self, module: nn.Module) -> PairHead:
        """Return the head of a network that `build` made."""
        return _network(module).head

    def encode(
        self, module: nn.Module, clouds: Sequence[Points], progress: Progress
    ) -> tuple[Tensor, list[Tensor]]:
        """Return descriptors (n, 1024), and of each cloud what the Chamfer branch sees, as in use."""
        device, frozen = _device(module), FrozenEncoder(_network(module).encoder)
        descriptors, compared = torch.empty(len(clouds), DESCRIPTOR), []
        for row, points in enumerate(clouds):
            if row % CLOUDS_PER_REPORT == 0:
                progress("encode", row / len(clouds))
            prepared = patch(points, size=self.patch_points, seed=self.seed)
            distinct, centroid = (
                torch.from_numpy(part).to(device) for part in (prepared.distinct, prepared.centroid)
            )
            descriptors[row] = frozen(distinct, centroid).cpu()
            sample = self._compared(prepared.distinct, np.random.default_rng((self.seed, 5, row)))
            compared.append(torch.from_numpy(sample))
        return descriptors, compared

    def compare(self, references: Sequence[Tensor], currents: Sequence[Tensor]) -> NDArray[np.float32]:
        """Return the statistics (n, 8 or 16)."""
        if not references:
            return np.zeros((0, PairHead(counts=self.counts).statistics), np.float32)
        statistics: NDArray[np.float32] = chamfer_statistics(references, currents, counts=self.counts).numpy()
        return statistics

    def swapped(self, statistics: NDArray[np.float32]) -> NDArray[np.float32]:
        """Exchange what is of one direction for what is of the other, (n, S) -> (n, S)."""
        exchanged: NDArray[np.float32] = swapped(torch.from_numpy(statistics)).numpy()
        return exchanged

    def _compared(self, distinct: Points, rng: np.random.Generator) -> Points:
        """Return all points, or a new draw without replacement from the padded patch (paper, Section 3.6.3)."""
        if self.chamfer_points is None:
            return distinct
        places = rng.choice(self.patch_points, self.chamfer_points, replace=False)
        return distinct[places % len(distinct)]


def _network(module: nn.Module) -> SpicdNetwork:
    if not isinstance(module, SpicdNetwork):
        raise TypeError(f"SPICD-Net is trained here, not {type(module).__name__}")
    return module


def _device(module: nn.Module) -> torch.device:
    return next(module.parameters()).device


def total_loss(logits: Tensor, labels: Tensor, transforms: tuple[Tensor, ...]) -> Tensor:
    """Return focal loss and the T-Nets' orthogonality, L = L_focal + 0.001 L_ortho."""
    return focal_loss(logits, labels) + ORTHOGONALITY * orthogonality(transforms)


def focal_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Return mean of -alpha_c (1 - p_c)^2 log p_c over (B, 3) logits, c the true class of each of (B,) labels."""
    log_p = logits.float().log_softmax(dim=1).gather(1, labels[:, None])[:, 0]  # (B,)
    alpha = torch.tensor(ALPHA, device=logits.device)[labels]
    return -(alpha * (1 - log_p.exp()) ** GAMMA * log_p).mean()


def orthogonality(transforms: tuple[Tensor, ...]) -> Tensor:
    """Return |I - A A'|^2 (Frobenius), averaged over the batch and over the T-Nets' matrices, each (B, k, k)."""
    losses = []
    for matrix in transforms:
        matrix = matrix.float()  # noqa: PLW2901
        identity = torch.eye(matrix.shape[1], device=matrix.device)
        losses.append((identity - matrix @ matrix.transpose(1, 2)).square().sum(dim=(1, 2)).mean())
    return torch.stack(losses).mean()
