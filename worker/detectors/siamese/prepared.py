"""Siamese networks whose encoder needs more than points: clouds are prepared by NumPy, and many make one batch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from worker.cloud.patches import Patch
from worker.cloud.types import Points
from worker.detectors.siamese.chamfer import chamfer_statistics
from worker.detectors.siamese.head import PairHead
from worker.detectors.siamese.training import (
    Batch,
    Encoder,
    SiameseTraining,
    both_sides,
    compared,
    device_of,
    focal_loss,
    labels_of,
)
from worker.detectors.trainable import Pair

C = TypeVar("C")  #: clouds as an encoder takes them, several end to end


class PreparedEncoder(nn.Module, ABC, Generic[C]):
    """Encodes clouds that `prepare` has prepared."""

    descriptor: ClassVar[int]  #: D, numbers of a descriptor
    coarse = False  #: whether a training step may take bfloat16 where that is quick

    @staticmethod
    @abstractmethod
    def prepare(clouds: Sequence[Points]) -> C:
        """Prepare distinct points (n, 3) of each, metres, tile-centre frame; no weight takes part."""

    @abstractmethod
    def forward(self, clouds: C) -> Tensor:
        """Return descriptors (B, D), on the device of the weights."""


def starts(sizes: Sequence[int]) -> list[int]:
    """Return where each of clouds of these sizes begins where they lie end to end."""
    return [0, *accumulate(sizes)][:-1]


class SiameseNetwork(nn.Module, Generic[C]):
    """A shared encoder and the head; with `counts` the head is given those of `chamfer.py` too."""

    def __init__(self, encoder: PreparedEncoder[C], *, counts: bool = False) -> None:
        super().__init__()
        self.counts = counts
        self.encoder = encoder
        self.head = PairHead(encoder.descriptor, counts=counts)

    def forward(self, clouds: C, references: Sequence[Tensor], currents: Sequence[Tensor]) -> Tensor:
        """Classify B pairs: (B, 3) logits.

        `clouds` are 2 B, the references before the currents; both branches are one batch. The other arguments are what
        the Chamfer branch compares, B clouds (n, 3) each, metres, tile-centre frame.
        """
        f_ref, f_cur = self.encoder(clouds).chunk(2)
        statistics = chamfer_statistics(references, currents, counts=self.counts)
        logits: Tensor = self.head(f_ref, f_cur, statistics)
        return logits


@dataclass(frozen=True, kw_only=True, slots=True)
class PreparedBatch(Batch, Generic[C]):
    """B examples whose 2 B clouds are prepared, references first."""

    clouds: C


class PreparedTraining(SiameseTraining[PreparedBatch[C]]):
    """TrainableNetwork (worker.detectors.trainable) of such an encoder."""

    __slots__ = ()

    encoder_class: ClassVar[type[PreparedEncoder[Any]]]

    def build(self, *, coarse_search: bool = False) -> SiameseNetwork[C]:
        """Return the network before training; with a coarse search its encoder may take steps in bfloat16."""
        encoder = self.encoder_class()
        encoder.coarse = coarse_search
        return SiameseNetwork(encoder, counts=self.counts)

    def collate(self, pairs: Sequence[Pair], rng: np.random.Generator) -> PreparedBatch[C]:
        """Prepare references before currents."""
        clouds = both_sides(pairs)
        samples = self._samples(clouds, rng)
        return PreparedBatch(
            clouds=self.encoder_class.prepare(clouds),
            chamfer_points=np.concatenate(samples),
            chamfer_sizes=[len(sample) for sample in samples],
            labels=labels_of(pairs),
        )

    def answer(self, module: nn.Module, batch: PreparedBatch[C]) -> tuple[Tensor, Tensor]:
        """Return logits (B, 3) and focal loss."""
        device = device_of(module)
        logits: Tensor = module(batch.clouds, *compared(batch, device))
        return logits, focal_loss(logits, torch.from_numpy(batch.labels).to(device))

    def descriptors(self, module: nn.Module, batch: PreparedBatch[C]) -> Tensor:
        """Encode the clouds of a batch as a training step does: (2 B, D)."""
        descriptors: Tensor = self._network(module).encoder(batch.clouds)
        return descriptors

    def head(self, module: nn.Module) -> PairHead:
        """Return the head of a network that `build` made."""
        return self._network(module).head

    def encoder(self, module: nn.Module) -> Encoder:
        """Return the encoder, which takes a patch's distinct points."""
        encoder = self._network(module).encoder.eval()

        @torch.inference_mode()
        def encode(patch: Patch) -> Tensor:
            descriptors: Tensor = encoder(encoder.prepare([patch.distinct]))
            return descriptors[0]

        return encode

    def _network(self, module: nn.Module) -> SiameseNetwork[C]:
        if not isinstance(module, SiameseNetwork):
            raise TypeError(f"a Siamese network is trained here, not {type(module).__name__}")
        return module
