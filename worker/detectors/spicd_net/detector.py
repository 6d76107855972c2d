"""SPICD-Net as a detector: tiles to patches, patches to descriptors, pairs to probabilities."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worker.detectors.card import Card
from worker.detectors.detector import TileScores
from worker.detectors.spicd_net.chamfer import SAMPLE_POINTS, chamfer_statistics
from worker.detectors.spicd_net.frozen import FrozenEncoder
from worker.detectors.spicd_net.network import DESCRIPTOR, SpicdNetwork
from worker.pipeline.patches import Patch, patch
from worker.pipeline.tiling import TilePairs, Tiles
from worker.pipeline.values import Arrays, Points
from worker.progress import Progress, silent

#: Tiles between two calls of `progress`, so how soon a dismissed job stops: some 40 ms on two cores.
TILES_PER_REPORT = 8

REFERENCE, CURRENT = 0, 1  #: streams of the Chamfer sample, so that two equal patches are not sampled alike


class SpicdNet:
    """Detector (worker.detectors.detector) around the network of the paper's Section 3.6.

    A reference is described by the encoder's output and the Chamfer sample of its patch; both depend on the
    reference alone, so a map keeps them and a survey encodes its own tiles only.
    """

    def __init__(self, card: Card, network: SpicdNetwork, device: torch.device) -> None:
        if card.preprocessing.patch_points < SAMPLE_POINTS:
            raise ValueError(
                f"the Chamfer sample takes {SAMPLE_POINTS} of a patch's points without replacement"
            )
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

    def describe(self, tiles: Tiles, *, progress: Progress = silent) -> Arrays:
        """`descriptors` (T, 1024) float32 and `samples` (T, 128, 3) float32, metres, tile-centre frame."""
        indices = np.arange(len(tiles.points))
        return self._described(
            tiles.points, tiles.grid.centers(tiles.indices), indices, REFERENCE, progress, "describe", False
        )

    def score(
        self,
        pairs: TilePairs,
        *,
        description: Arrays | None = None,
        progress: Progress = silent,
        padded: bool = False,
    ) -> TileScores:
        """Compare every observed pair; rows of unobserved tiles are NaN.

        `description` is `describe(pairs.reference)`; without it the reference is described here. `padded` runs
        both branches on the padded patches of the paper and keeps nothing: the same scores within 1e-4, for
        the bench. Raises ValueError for a description of other tiles.
        """
        centres = pairs.reference.grid.centers(pairs.reference.indices)
        observed = np.flatnonzero(pairs.observed)
        probabilities = np.full((len(pairs.observed), 3), np.nan, dtype=np.float32)
        if len(observed) == 0:
            return TileScores(probabilities=probabilities)
        if description is None or padded:
            reference = self._described(
                pairs.reference.points, centres, observed, REFERENCE, progress, "describe", padded
            )
        else:
            reference = _selected(description, observed, tiles=len(pairs.observed))
        current = self._described(pairs.current, centres, observed, CURRENT, progress, "score", padded)
        probabilities[observed] = self._compare(reference, current)
        return TileScores(probabilities=probabilities)

    def _described(
        self,
        points: tuple[Points, ...],
        centres: NDArray[np.float64],
        indices: NDArray[np.intp],
        stream: int,
        progress: Progress,
        stage: str,
        padded: bool,
    ) -> Arrays:
        preprocessing = self.card.preprocessing
        descriptors = np.empty((len(indices), DESCRIPTOR), dtype=np.float32)
        samples = np.empty((len(indices), SAMPLE_POINTS, 3), dtype=np.float32)
        chosen = _sample_indices(preprocessing.patch_points, preprocessing.seed, stream)
        for row, tile in _reporting(indices, progress, stage):
            local = (points[tile] - centres[tile]).astype(np.float32)
            prepared = patch(local, size=preprocessing.patch_points, seed=preprocessing.seed)
            descriptors[row] = self._encode(prepared, padded).cpu().numpy()
            samples[row] = prepared.at(chosen)
        return {"descriptors": descriptors, "samples": samples}

    def _encode(self, prepared: Patch, padded: bool) -> Tensor:
        if padded:
            with torch.inference_mode():
                written_out = torch.from_numpy(prepared.padded() - prepared.centroid).to(self._device)
                descriptor: Tensor = self._network.encoder(written_out, [len(written_out)])[0][0]
                return descriptor
        distinct = torch.from_numpy(prepared.distinct).to(self._device)
        return self._encoder(distinct, torch.from_numpy(prepared.centroid).to(self._device))

    @torch.inference_mode()
    def _compare(self, reference: Arrays, current: Arrays) -> NDArray[np.float32]:
        """Two descriptions of the same (t,) tiles -> (t, 3) probabilities."""
        f_ref, f_cur, s_ref, s_cur = (
            torch.from_numpy(np.ascontiguousarray(side[name], dtype=np.float32)).to(self._device)
            for name in ("descriptors", "samples")
            for side in (reference, current)
        )
        logits: Tensor = self._network.head(f_ref, f_cur, chamfer_statistics(s_ref, s_cur))
        probabilities: NDArray[np.float32] = logits.softmax(dim=1).cpu().numpy()
        return probabilities


def _sample_indices(size: int, seed: int, stream: int) -> NDArray[np.int64]:
    """(128,) of the padded patch's points, without replacement."""
    return np.random.default_rng((seed, stream)).choice(size, SAMPLE_POINTS, replace=False)


def _selected(description: Arrays, observed: NDArray[np.intp], *, tiles: int) -> Arrays:
    expected = {"descriptors": (tiles, DESCRIPTOR), "samples": (tiles, SAMPLE_POINTS, 3)}
    for name, shape in expected.items():
        found = description[name].shape if name in description else None
        if found != shape:
            raise ValueError(
                f"the description's {name} are {found}, not {shape}: it is of another map or model"
            )
    return {name: description[name][observed] for name in expected}


def _reporting(indices: NDArray[np.intp], progress: Progress, stage: str) -> Iterator[tuple[int, int]]:
    """(row, tile) of each index, with a report before every few and at the end."""
    for row, tile in enumerate(indices.tolist()):
        if row % TILES_PER_REPORT == 0:
            progress(stage, row / len(indices))
        yield row, tile
    progress(stage, 1.0)
