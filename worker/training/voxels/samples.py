"""Samples: the evidence of one comparison in one direction, with the truth about each voxel, in one .npz file each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worker.cloud import npz
from worker.cloud.seen import Seen
from worker.cloud.types import Bools
from worker.cloud.voxel_keys import Keys, rows_of
from worker.detectors.voxels.evidence import EvidenceSettings, free_space, gathered, missing

UNKNOWN, THERE, MISSING = -1, 0, 1  #: labels; of what own hit, by whether other has it too


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VoxelSample:
    """N voxels around the candidates of one comparison."""

    keys: Keys  #: (N,) ascending
    channels: NDArray[np.float16]  #: (N, 12) of `Evidence`
    labels: NDArray[np.int8]  #: (N,) UNKNOWN where nobody can tell, or the gate is shut: not learned from
    free_space: bool  #: whether both visits had sights
    building: int  #: which building it is of

    @classmethod
    def of(
        cls, own: Seen, other: Seen, truth: NDArray[np.int8], settings: EvidenceSettings, *, building: int
    ) -> VoxelSample | None:
        """Gather the evidence that a detector would, with the truth (V,) about the voxels of `own`.

        Returns None where there is no candidate.
        """
        lacks = missing(own, other, settings)
        if not len(lacks.candidates):
            return None
        evidence = gathered(own, other, lacks.candidates, settings)
        rows = rows_of(evidence.keys, own.keys)
        told: Bools = (rows >= 0) & lacks.judged[rows]
        return cls(
            keys=evidence.keys,
            channels=evidence.channels.astype(np.float16),
            labels=np.where(told, truth[rows], UNKNOWN).astype(np.int8),
            free_space=free_space(own, other),
            building=building,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class SampleSet:
    """All samples of a site, in one file."""

    samples: tuple[VoxelSample, ...]


def save_samples(folder: Path, samples: list[VoxelSample], *, name: str) -> None:
    """Write them as `name-NNN.npz`. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, sample in enumerate(samples):
        npz.save(folder / f"{name}-{number:03d}.npz", sample)


def load_samples(folder: Path) -> list[VoxelSample]:
    """Read all samples of a folder, in the order of their names. Raises OSError, ValueError for other files."""
    return [npz.load(path, VoxelSample) for path in sorted(folder.glob("*.npz"))]
