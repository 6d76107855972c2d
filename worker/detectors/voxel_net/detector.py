"""The detector: evidence around candidates, the network both ways, tiles made of voxels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from worker.cloud.settings import StrictModel
from worker.detectors.card import Card
from worker.detectors.precision import Precision, chosen_precision
from worker.detectors.running.calls import NetworkCall
from worker.detectors.running.runtime import Runtime
from worker.detectors.voxel_net.network import WIDTHS, Looked, VoxelNetwork, probabilities_each
from worker.detectors.voxels.evidence import Evidence, EvidenceSettings
from worker.detectors.voxels.scores import Scorer, TileScoreSettings

Weights = dict[str, Tensor]

#: The two networks of a model, by the prefix of their weights' names.
SEEING, BLIND = "seeing", "blind"  #: with free space, and for clouds without a sensor's place


A_TILES_VOXELS = 4096  #: that take about the memory of a patch, by which batches are measured


class VoxelNetSettings(StrictModel):
    """`detector_settings` of a card of this detector."""

    widths: tuple[int, ...] = Field(WIDTHS, min_length=1, description="channels at 2, 4, 8, ... voxels")
    head: int = Field(32, gt=0, description="channels of the head")
    evidence: EvidenceSettings = EvidenceSettings.model_validate({})
    tiles: TileScoreSettings = TileScoreSettings.model_validate({})

    def build(self) -> VoxelNetwork:
        """Return a network before training."""
        return VoxelNetwork(self.widths, self.head)


class VoxelNet(Scorer):
    """Detector (worker.detectors.detector) that weighs the evidence by a network; it has one for blind clouds."""

    settings_class = VoxelNetSettings
    precisions: ClassVar[tuple[Precision, ...]] = ("float32", "bfloat16")

    def __init__(self, card: Card, networks: dict[str, VoxelNetwork], device: torch.device) -> None:
        settings = card.settings_as(VoxelNetSettings)
        super().__init__(card, settings.evidence, settings.tiles)
        self._networks = {name: network.to(device).eval() for name, network in networks.items()}
        self._device = device
        self._precision: Precision = "float32"
        self._batches = Runtime().batches

    def run_with(self, runtime: Runtime) -> None:
        """Run the networks so from now on (worker.detectors.running.runtime)."""
        self._batches = runtime.batches
        holds = self.card.holds_in_bfloat16(self._device.type)
        self._precision = chosen_precision(runtime.precision, self._device, holds=holds)

    def _call(self, name: str) -> NetworkCall[Looked, NDArray[np.float32]]:
        """Make a call when it is asked for: kept, it and the detector would hold each other, and the weights with them."""

        def run(clouds: Sequence[Looked]) -> list[NDArray[np.float32]]:
            return probabilities_each(self._networks[name], clouds, self._device, self._precision)

        return NetworkCall(
            model=self.card.model,
            function=name,
            fingerprint=self.card.fingerprint,
            run=run,
            size=lambda cloud: max(1, len(cloud.channels) // A_TILES_VOXELS),
        )

    @classmethod
    def load(cls, card: Card, weights: Weights, device: torch.device) -> Self:
        """Open a model. Raises RuntimeError for weights of another network, ValueError for unsound settings."""
        settings = card.settings_as(VoxelNetSettings)
        networks = {name: settings.build() for name in (SEEING, BLIND)}
        for name, network in networks.items():
            network.load_state_dict(weights_under(name, weights))
        return cls(card, networks, device)

    def weights(self) -> Weights:
        """Return what `load` takes."""
        return joined({name: network.state_dict() for name, network in self._networks.items()})

    def score(self, evidence: Evidence, *, free_space: bool) -> NDArray[np.float32]:
        """Return (N,) the network's probabilities."""
        name = SEEING if free_space else BLIND
        cloud = Looked.at(self._networks[name], evidence.keys, evidence.channels)
        (told,) = self._batches.run(self._call(name), [cloud], lambda _: None)
        return told


def joined(states: dict[str, Weights]) -> Weights:
    """Return the weights of several networks under one roof, each name with its network's before it."""
    return {f"{name}.{key}": value for name, state in states.items() for key, value in state.items()}


def weights_under(name: str, weights: Weights) -> Weights:
    """Return the weights of one network out of those of a model."""
    return {
        key.removeprefix(f"{name}."): value for key, value in weights.items() if key.startswith(f"{name}.")
    }
