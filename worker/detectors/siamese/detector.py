"""A Siamese network as a detector: tiles to patches, patches to descriptors, pairs to probabilities."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, model_validator
from torch import Tensor, nn

from worker.cloud.patches import Patch, patch
from worker.cloud.settings import StrictModel
from worker.cloud.tiling import TilePairs, Tiles
from worker.cloud.types import Arrays, Points
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.detectors.precision import Precision, chosen_precision
from worker.detectors.running.calls import NetworkCall
from worker.detectors.running.runtime import Runtime
from worker.detectors.siamese.chamfer import chamfer_statistics
from worker.detectors.siamese.head import PairHead
from worker.errors import DetectorUnavailable
from worker.progress import Progress, no_progress

#: Tiles of a batch on a processor, so between two calls of `progress`, and how soon a dismissed job stops: some 40 ms on
#: two cores. More at once are no faster there.
CPU_TILES = 8

REFERENCE, CURRENT = 0, 1  #: streams of the Chamfer sample, so that two equal patches are not sampled alike


class SiameseSettings(StrictModel):
    """`detector_settings` of a card of such a detector: what of the input is tied to the weights."""

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


#: Descriptors (D,) of both sides, and the two clouds that the Chamfer branch compares.
_Compared = tuple[NDArray[np.float32], NDArray[np.float32], tuple[Points, Points]]


class SiameseDetector(ABC):
    """Detector (worker.detectors.detector) around an encoder and the head of the paper's Section 3.6.

    A tile of the map is encoded by itself, so a map keeps its descriptors and a survey encodes its own tiles only.
    A detector of this kind says how patches are encoded, and opens its network (`load`).
    """

    settings_class: ClassVar[type[SiameseSettings]] = SiameseSettings
    precisions: ClassVar[tuple[Precision, ...]] = ("float32",)

    def __init__(self, card: Card, network: nn.Module, head: PairHead, device: torch.device) -> None:
        """Take a network in whose weights those of `head` are."""
        self.card = card
        self._settings = card.settings_as(self.settings_class)
        self._device = device
        self._network = network.to(device).eval()
        self._head = head
        self._batches = Runtime().batches

    def run_with(self, runtime: Runtime) -> None:
        """Run the network so from now on (worker.detectors.running.runtime)."""
        self._batches = runtime.batches
        at_once = self._device.type == "cuda" if runtime.at_once is None else runtime.at_once
        holds = "bfloat16" in self.precisions and self.card.holds_in_bfloat16("cuda" if at_once else "cpu")
        precision = chosen_precision(runtime.precision, self._device, holds=holds)
        if precision not in self.precisions:
            raise DetectorUnavailable(
                f"model {self.card.model} computes in {' or '.join(self.precisions)}, not in {precision}; "
                "set SPICD_INFERENCE_PRECISION to auto"
            )
        self._encode_with(precision, at_once=at_once)

    def _encode_with(self, precision: Precision, *, at_once: bool) -> None:
        """Encode in this precision from now on; `at_once`: a batch as one, as a GPU does best."""
        self._precision, self._at_once = precision, at_once

    @abstractmethod
    def _descriptors(self, patches: Sequence[Patch]) -> Tensor:
        """Encode a few patches, one at least, on the device: (n, D)."""

    def _call(self, function: str, run: Any, most: int | None = None) -> NetworkCall[Any, Any]:
        """Make a call when it is asked for: kept, it and the detector would hold each other, and the weights with them."""
        card = self.card
        return NetworkCall(
            model=card.model, function=function, fingerprint=card.fingerprint, run=run, most=most
        )

    def _descriptors_each(self, patches: Sequence[Patch]) -> list[NDArray[np.float32]]:
        """Encode patches in one batch: a descriptor (D,) of each."""
        return list(self._descriptors(patches).cpu().numpy())

    def weights(self) -> dict[str, Tensor]:
        """Return what `load` takes, to train further from."""
        return dict(self._network.state_dict())

    def held_tensors(self) -> Iterator[Tensor]:
        """Yield all that is kept on the device, some perhaps twice."""
        yield from self._network.state_dict().values()

    def encode_reference(
        self,
        reference: Side,  # noqa: ARG002
        tiles: Tiles,
        *,
        progress: Progress = no_progress,
    ) -> Arrays:
        """Return `descriptors` (T, D) float32."""
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
            known = self._selected(embedding, observed, tiles=len(pairs.observed))
        seen = self._encoded(after, progress, "scoring")
        probabilities[observed] = self._probabilities(known, seen, self._pairs(before, after), progress)
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
        """Return the descriptors (t, D)."""
        if not patches:
            progress(stage, 1.0)
            return np.empty((0, self._head.descriptor), np.float32)

        def done(count: int) -> None:
            progress(stage, count / len(patches))

        few = CPU_TILES if self._device.type == "cpu" else None
        encoding = self._call("encode", self._descriptors_each, most=few)
        return np.stack(self._batches.run(encoding, patches, done))

    def _pairs(self, before: Sequence[Patch], after: Sequence[Patch]) -> list[tuple[Points, Points]]:
        """Return what of each pair of patches the Chamfer branch sees, (n, 3) and (m, 3)."""
        return list(zip(self._compared(before, REFERENCE), self._compared(after, CURRENT), strict=True))

    def _compared(self, patches: Sequence[Patch], stream: int) -> list[Points]:
        settings = self._settings
        if settings.chamfer_points is None:
            return [prepared.distinct for prepared in patches]
        places = np.random.default_rng((settings.seed, stream)).choice(
            settings.patch_points, settings.chamfer_points, replace=False
        )
        return [prepared.points_at(places) for prepared in patches]

    def _probabilities(
        self,
        reference: NDArray[np.float32],
        current: NDArray[np.float32],
        clouds: Sequence[tuple[Points, Points]],
        progress: Progress,
    ) -> NDArray[np.float32]:
        """Classify descriptors (t, D) of both sides and t pairs of clouds: (t, 3).

        A processor does it in the thread that asks, where k-d trees of several steps go side by side.
        """
        items = list(zip(reference, current, clouds, strict=True))
        if self._device.type == "cpu":
            return np.stack(self._compare(items))
        comparing = self._call("compare", self._compare)
        return np.stack(self._batches.run(comparing, items, lambda _: progress("scoring", 1.0)))

    @torch.inference_mode()
    def _compare(self, items: Sequence[_Compared]) -> list[NDArray[np.float32]]:
        """Classify pairs in one batch: probabilities (3,) of each."""
        references, currents, clouds = zip(*items, strict=True)
        f_ref, f_cur = (self._placed(np.stack(side)) for side in (references, currents))
        before, after = ([self._placed(cloud) for cloud in side] for side in zip(*clouds, strict=True))
        statistics = chamfer_statistics(before, after, counts=self._settings.counts)
        logits: Tensor = self._head(f_ref, f_cur, statistics)
        return list(logits.softmax(dim=1).cpu().numpy())

    def _placed(self, array: NDArray[np.float32]) -> Tensor:
        return torch.from_numpy(array).to(self._device)

    def _selected(self, embedding: Arrays, observed: NDArray[np.intp], *, tiles: int) -> NDArray[np.float32]:
        descriptors, expected = embedding.get("descriptors"), (tiles, self._head.descriptor)
        if descriptors is None or descriptors.shape != expected:
            shape = None if descriptors is None else descriptors.shape
            raise ValueError(
                f"the embedding's descriptors are {shape}, not {expected}: it is of another map or model"
            )
        return np.ascontiguousarray(descriptors[observed], dtype=np.float32)
