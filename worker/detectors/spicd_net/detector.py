"""SPICD-Net as a detector: tiles to patches, patches to descriptors, pairs to probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch import Tensor

from worker.cloud.patches import Patch, patch
from worker.cloud.settings import StrictModel
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays, Points
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.detectors.spicd_net.chamfer import chamfer_statistics
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.network import DESCRIPTOR, SpicdNetwork
from worker.progress import Progress, no_progress

#: Tiles between two calls of `progress`, so how soon a dismissed job stops: some 40 ms on two cores.
TILES_PER_REPORT = 8

REFERENCE, CURRENT = 0, 1  #: streams of the Chamfer sample, so that two equal patches are not sampled alike


class SpicdNetSettings(StrictModel):
    """`detector_settings` of a card of this detector: what of the input is tied to the weights."""

    patch_points: int = Field(gt=0, description="points of a patch after FPS and repetition")
    chamfer_points: int | None = Field(
        default=128,
        gt=0,
        description="of each patch, that are compared; null: all, where the paper takes 128",
    )
    counts: bool = Field(
        default=False,
        description="whether the head is given, beside the paper's statistics, how many points are more and far",
    )
    seed: int = Field(description="of FPS and of the Chamfer sample")

    @model_validator(mode="after")
    def _sample_fits(self) -> Self:
        if self.chamfer_points is not None and self.patch_points < self.chamfer_points:
            raise ValueError(
                f"the Chamfer sample takes {self.chamfer_points} of a patch's {self.patch_points} points "
                "without replacement"
            )
        return self


class SpicdNet:
    """Detector (worker.detectors.detector) around the network of the paper's Section 3.6.

    A tile of the map is encoded by itself, so a map keeps its descriptors and a survey encodes its own tiles only.
    """

    settings_class = SpicdNetSettings

    def __init__(self, card: Card, network: SpicdNetwork, device: torch.device) -> None:
        self.card = card
        self._settings = card.settings_as(SpicdNetSettings)
        self._device = device
        self._network = network.to(device).eval()
        self._encoder = FrozenEncoder(self._network.encoder)

    @classmethod
    def load(cls, card: Card, weights: dict[str, Tensor], device: torch.device) -> SpicdNet:
        """Open a model. Raises RuntimeError for weights of another network, ValueError for unsound settings."""
        network = SpicdNetwork(counts=card.settings_as(SpicdNetSettings).counts)
        network.load_state_dict(weights)
        return cls(card, network, device)

    def weights(self) -> dict[str, Tensor]:
        """Return what `load` takes, to train further from."""
        return dict(self._network.state_dict())

    def encode_reference(
        self,
        reference: Side,  # noqa: ARG002
        tiles: Tiles,
        *,
        progress: Progress = no_progress,
    ) -> Arrays:
        """Return `descriptors` (T, 1024) float32."""
        patches = self._patches(tiles, tiles.points, np.arange(len(tiles.points)))
        return {"descriptors": self._encoded(patches, progress, "encoding")}

    def detect(
        self, comparison: Comparison, *, embedding: Arrays | None = None, progress: Progress = no_progress
    ) -> Detection:
        """Compare every observed pair; rows of unobserved tiles are NaN.

        Without the map's embedding its tiles are encoded here. Raises ValueError for an embedding of other tiles.
        """
        pairs = comparison.tile_pairs
        observed = np.flatnonzero(pairs.observed)
        probabilities = np.full((len(pairs.observed), 3), np.nan, dtype=np.float32)
        if len(observed) == 0:
            return Detection(probabilities=probabilities)
        before, after = self._both(pairs, observed)
        if embedding is None:
            known = self._encoded(before, progress, "encoding")
        else:
            known = _selected(embedding, observed, tiles=len(pairs.observed))
        seen = self._encoded(after, progress, "scoring")
        probabilities[observed] = self._probabilities(known, seen, self._statistics(before, after))
        return Detection(probabilities=probabilities)

    def _both(self, pairs: TilePairs, chosen: NDArray[np.intp]) -> tuple[list[Patch], list[Patch]]:
        return (
            self._patches(pairs.reference, pairs.reference.points, chosen),
            self._patches(pairs.reference, pairs.current, chosen),
        )

    def _patches(self, tiles: Tiles, points: Sequence[Points], indices: NDArray[np.intp]) -> list[Patch]:
        """Return patches of the tiles at these indices, with these points (n, 3), metres, map frame."""
        settings, centres = self._settings, tiles.grid.centers(tiles.indices)
        return [
            patch(
                (points[tile] - centres[tile]).astype(np.float32),
                size=settings.patch_points,
                seed=settings.seed,
            )
            for tile in indices.tolist()
        ]

    def _encoded(self, patches: Sequence[Patch], progress: Progress, stage: str) -> NDArray[np.float32]:
        """Return the descriptors (t, 1024)."""
        descriptors = np.empty((len(patches), DESCRIPTOR), dtype=np.float32)
        for row, prepared in enumerate(patches):
            if row % TILES_PER_REPORT == 0:
                progress(stage, row / len(patches))
            distinct, centroid = (
                torch.from_numpy(part).to(self._device) for part in (prepared.distinct, prepared.centroid)
            )
            descriptors[row] = self._encoder(distinct, centroid).cpu().numpy()
        progress(stage, 1.0)
        return descriptors

    def _statistics(self, before: Sequence[Patch], after: Sequence[Patch]) -> Tensor:
        compared = self._compared(before, REFERENCE), self._compared(after, CURRENT)
        return chamfer_statistics(*compared, counts=self._settings.counts)

    def _compared(self, patches: Sequence[Patch], stream: int) -> list[Tensor]:
        """Return what of each patch the Chamfer branch sees, (n, 3)."""
        settings = self._settings
        if settings.chamfer_points is None:
            clouds = [prepared.distinct for prepared in patches]
        else:
            places = np.random.default_rng((settings.seed, stream)).choice(
                settings.patch_points, settings.chamfer_points, replace=False
            )
            clouds = [prepared.points_at(places) for prepared in patches]
        return [torch.from_numpy(cloud).to(self._device) for cloud in clouds]

    @torch.inference_mode()
    def _probabilities(
        self, reference: NDArray[np.float32], current: NDArray[np.float32], statistics: Tensor
    ) -> NDArray[np.float32]:
        """Classify descriptors (t, 1024) of both sides and statistics (t, 8 or 16): (t, 3)."""
        f_ref, f_cur = (torch.from_numpy(side).to(self._device) for side in (reference, current))
        logits: Tensor = self._network.head(f_ref, f_cur, statistics)
        probabilities: NDArray[np.float32] = logits.softmax(dim=1).cpu().numpy()
        return probabilities


def _selected(embedding: Arrays, observed: NDArray[np.intp], *, tiles: int) -> NDArray[np.float32]:
    descriptors = embedding.get("descriptors")
    if descriptors is None or descriptors.shape != (tiles, DESCRIPTOR):
        shape = None if descriptors is None else descriptors.shape
        raise ValueError(
            f"the embedding's descriptors are {shape}, not {(tiles, DESCRIPTOR)}: it is of another map or model"
        )
    return np.ascontiguousarray(descriptors[observed], dtype=np.float32)
