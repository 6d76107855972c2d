"""SPICD-Net as a detector: tiles to patches, patches to descriptors, pairs to probabilities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worker.cloud.patches import Patch, patch
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays, Points
from worker.detectors.card import Card
from worker.detectors.detector import TileScores
from worker.detectors.spicd_net.chamfer import STATISTICS, chamfer_statistics
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.network import DESCRIPTOR, SpicdNetwork
from worker.progress import Progress, no_progress

#: Tiles between two calls of `progress`, so how soon a dismissed job stops: some 40 ms on two cores.
TILES_PER_REPORT = 8

REFERENCE, CURRENT = 0, 1  #: streams of the Chamfer sample, so that two equal patches are not sampled alike


class SpicdNet:
    """Detector (worker.detectors.detector) around the network of the paper's Section 3.6.

    A reference is described by the encoder's output, which depends on the reference alone, so a map keeps it and a
    survey encodes its own tiles only.
    """

    def __init__(self, card: Card, network: SpicdNetwork, device: torch.device) -> None:
        sample = card.preprocessing.chamfer_points
        if sample is not None and card.preprocessing.patch_points < sample:
            raise ValueError(f"the Chamfer sample takes {sample} of a patch's points without replacement")
        self.card = card
        self._device = device
        self._network = network.to(device).eval()
        self._encoder = FrozenEncoder(self._network.encoder)

    @classmethod
    def load(cls, card: Card, weights: dict[str, Tensor], device: torch.device) -> SpicdNet:
        """With weights from a file. Raises RuntimeError when they are not of this network."""
        network = SpicdNetwork()
        network.load_state_dict(weights)
        return cls(card, network, device)

    def weights(self) -> dict[str, Tensor]:
        """What `load` takes, to train further from."""
        return dict(self._network.state_dict())

    def describe(self, tiles: Tiles, *, progress: Progress = no_progress) -> Arrays:
        """`descriptors` (T, 1024) float32."""
        patches = self._patches(tiles, tiles.points, np.arange(len(tiles.points)))
        return {"descriptors": self._encoded(patches, progress, "describe", padded=False)}

    def score(
        self,
        pairs: TilePairs,
        *,
        description: Arrays | None = None,
        progress: Progress = no_progress,
        padded: bool = False,
    ) -> TileScores:
        """Compare every observed pair; rows of unobserved tiles are NaN.

        `description` is `describe(pairs.reference)`; without it the reference is described here. `padded` runs
        both branches on the padded patches of the paper and keeps nothing: the same scores within 1e-4, for
        the bench. Raises ValueError for a description of other tiles.
        """
        observed = np.flatnonzero(pairs.observed)
        probabilities = np.full((len(pairs.observed), 3), np.nan, dtype=np.float32)
        if len(observed) == 0:
            return TileScores(probabilities=probabilities)
        before, after = self._both(pairs, observed)
        if description is None or padded:
            known = self._encoded(before, progress, "describe", padded=padded)
        else:
            known = _selected(description, observed, tiles=len(pairs.observed))
        found = self._encoded(after, progress, "score", padded=padded)
        probabilities[observed] = self._probabilities(known, found, self._statistics(before, after))
        return TileScores(probabilities=probabilities)

    def statistics(self, pairs: TilePairs) -> NDArray[np.float32]:
        """(T, 8) what the Chamfer branch is given; NaN where not observed."""
        observed = np.flatnonzero(pairs.observed)
        found = np.full((len(pairs.observed), STATISTICS), np.nan, np.float32)
        if len(observed):
            found[observed] = self._statistics(*self._both(pairs, observed)).cpu().numpy()
        return found

    def _both(self, pairs: TilePairs, chosen: NDArray[np.intp]) -> tuple[list[Patch], list[Patch]]:
        return (
            self._patches(pairs.reference, pairs.reference.points, chosen),
            self._patches(pairs.reference, pairs.current, chosen),
        )

    def _patches(self, tiles: Tiles, points: Sequence[Points], indices: NDArray[np.intp]) -> list[Patch]:
        """Of the tiles at these indices, with these points (n, 3), metres, map frame."""
        preprocessing, centres = self.card.preprocessing, tiles.grid.centers(tiles.indices)
        return [
            patch(
                (points[tile] - centres[tile]).astype(np.float32),
                size=preprocessing.patch_points,
                seed=preprocessing.seed,
            )
            for tile in indices.tolist()
        ]

    def _encoded(
        self, patches: Sequence[Patch], progress: Progress, stage: str, *, padded: bool
    ) -> NDArray[np.float32]:
        """(t, 1024)"""
        descriptors = np.empty((len(patches), DESCRIPTOR), dtype=np.float32)
        for row, prepared in enumerate(patches):
            if row % TILES_PER_REPORT == 0:
                progress(stage, row / len(patches))
            descriptors[row] = self._encode(prepared, padded).cpu().numpy()
        progress(stage, 1.0)
        return descriptors

    def _encode(self, prepared: Patch, padded: bool) -> Tensor:
        if padded:
            with torch.inference_mode():
                written_out = torch.from_numpy(prepared.padded() - prepared.centroid).to(self._device)
                descriptor: Tensor = self._network.encoder(written_out, [len(written_out)])[0][0]
                return descriptor
        distinct = torch.from_numpy(prepared.distinct).to(self._device)
        return self._encoder(distinct, torch.from_numpy(prepared.centroid).to(self._device))

    def _statistics(self, before: Sequence[Patch], after: Sequence[Patch]) -> Tensor:
        return chamfer_statistics(self._compared(before, REFERENCE), self._compared(after, CURRENT))

    def _compared(self, patches: Sequence[Patch], stream: int) -> list[Tensor]:
        """What of each patch the Chamfer branch sees, (n, 3)."""
        preprocessing = self.card.preprocessing
        if preprocessing.chamfer_points is None:
            clouds = [prepared.distinct for prepared in patches]
        else:
            places = np.random.default_rng((preprocessing.seed, stream)).choice(
                preprocessing.patch_points, preprocessing.chamfer_points, replace=False
            )
            clouds = [prepared.at(places) for prepared in patches]
        return [torch.from_numpy(cloud).to(self._device) for cloud in clouds]

    @torch.inference_mode()
    def _probabilities(
        self, reference: NDArray[np.float32], current: NDArray[np.float32], statistics: Tensor
    ) -> NDArray[np.float32]:
        """Descriptors (t, 1024) of both sides and (t, 8) -> (t, 3)"""
        f_ref, f_cur = (torch.from_numpy(side).to(self._device) for side in (reference, current))
        logits: Tensor = self._network.head(f_ref, f_cur, statistics)
        probabilities: NDArray[np.float32] = logits.softmax(dim=1).cpu().numpy()
        return probabilities


def _selected(description: Arrays, observed: NDArray[np.intp], *, tiles: int) -> NDArray[np.float32]:
    found = description.get("descriptors")
    if found is None or found.shape != (tiles, DESCRIPTOR):
        shape = None if found is None else found.shape
        raise ValueError(
            f"the description's descriptors are {shape}, not {(tiles, DESCRIPTOR)}: it is of another map or model"
        )
    return np.ascontiguousarray(found[observed], dtype=np.float32)
