"""The network: a sparse U-Net at twice, four and eight times the voxel size, and a head a voxel.

Siamese by construction: it is asked in one direction at a time, own against other, and is the same for both. To swap
map and survey swaps its two answers bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from worker.cloud.voxel_keys import Keys
from worker.detectors.precision import Precision, autocast
from worker.detectors.voxel_net.sparse import (
    CHILDREN,
    Convolution,
    Level,
    Merge,
    Split,
    pyramid,
    side_by_side,
)
from worker.detectors.voxels.evidence import CHANNELS

WIDTHS = (16, 24, 32)


class _Block(nn.Module):
    """Two convolutions with a way around them (He et al., CVPR 2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = Convolution(width, width), Convolution(width, width)
        self.norms = nn.ModuleList([nn.BatchNorm1d(width), nn.BatchNorm1d(width)])

    def forward(self, features: Tensor, level: Level) -> Tensor:
        inner = torch.relu(self.norms[0](self.first(features, level)))
        return torch.relu(features + self.norms[1](self.second(inner, level)))


class VoxelNetwork(nn.Module):
    """Logits (N,) that what own hit in a voxel is missing from other, of channels (N, 12) of `Evidence`."""

    def __init__(self, widths: tuple[int, ...] = WIDTHS, head: int = 32) -> None:
        super().__init__()
        self.levels = len(widths)
        inner = (CHANNELS, *widths[:-1])
        self.merges = nn.ModuleList([Merge(a, b) for a, b in zip(inner, widths, strict=True)])
        self.merge_norms = nn.ModuleList([nn.BatchNorm1d(width) for width in widths])
        self.blocks = nn.ModuleList([_Block(width) for width in widths])
        pairs = list(zip(widths[1:], widths[:-1], strict=True))
        self.splits = nn.ModuleList([Split(a, b) for a, b in pairs])
        self.joins = nn.ModuleList([nn.Linear(2 * b, b) for _, b in pairs])
        self.ups = nn.ModuleList([_Block(b) for _, b in pairs])
        self.head = nn.Sequential(
            nn.Linear(widths[0] + CHILDREN + CHANNELS, head),
            nn.ReLU(),
            nn.Linear(head, head),
            nn.ReLU(),
            nn.Linear(head, 1),
        )

    def forward(self, channels: Tensor, levels: list[Level]) -> Tensor:
        """Return (N,) logits; `levels` are the pyramid over the voxels."""
        features, kept = channels, []
        for merge, norm, block, level in zip(self.merges, self.merge_norms, self.blocks, levels, strict=True):
            features = block(torch.relu(norm(merge(features, level))), level)
            kept.append(features)
        for depth in range(self.levels - 2, -1, -1):
            split = self.splits[depth](features, levels[depth + 1])
            features = torch.relu(self.joins[depth](torch.cat([kept[depth], split], dim=1)))
            features = self.ups[depth](features, levels[depth])
        finest = levels[0]
        which = nn.functional.one_hot(finest.child, CHILDREN).to(channels.dtype)
        voxels = torch.cat([features.index_select(0, finest.parent), which, channels], dim=1)
        logits: Tensor = self.head(voxels).squeeze(1)
        return logits


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Looked:
    """What the network is asked of one cloud, prepared on the processor."""

    channels: NDArray[np.float32]  #: (N, 12)
    levels: list[Level]  #: the pyramid over the N voxels

    @classmethod
    def at(cls, network: VoxelNetwork, keys: Keys, channels: NDArray[np.float32]) -> Looked:
        """Prepare voxels of ascending keys (N,)."""
        return cls(channels=channels, levels=pyramid(keys, network.levels))


@torch.inference_mode()
def probabilities_each(
    network: VoxelNetwork, clouds: Sequence[Looked], device: torch.device, precision: Precision = "float32"
) -> list[NDArray[np.float32]]:
    """Return (N,) probabilities of the voxels of each cloud, which see nothing of each other."""
    levels = [level.to(device) for level in side_by_side([cloud.levels for cloud in clouds])]
    channels = torch.from_numpy(np.concatenate([cloud.channels for cloud in clouds])).to(device)
    with autocast(device, precision):
        logits = network(channels, levels)
    told = torch.sigmoid(logits.float()).cpu().numpy()
    return np.split(told, np.cumsum([len(cloud.channels) for cloud in clouds])[:-1])


def probabilities(
    network: VoxelNetwork, keys: Keys, channels: NDArray[np.float32], device: torch.device
) -> NDArray[np.float32]:
    """Return (N,) probabilities of voxels of ascending keys (N,)."""
    return probabilities_each(network, [Looked.at(network, keys, channels)], device)[0]
