"""The simplest detector of voxels: hit by one visit, seen through by the other, and nothing of the other beside it."""

from __future__ import annotations

import numpy as np

from worker.cloud.seen import Seen
from worker.cloud.types import Bools
from worker.cloud.voxel_keys import Keys, near, rows_of
from worker.detectors.detector import Probabilities, VoxelScores


def rule_scores(before: Seen, now: Seen, *, clear: int = 1) -> VoxelScores:
    """Judge every voxel that either visit hit; `clear` voxels around a changed one are empty in the other visit."""
    keys = np.union1d(before.keys, now.keys)
    disappeared, gone_judged, gone_through, gone_moving = _one_way(keys, before, now, clear)
    appeared, come_judged, come_through, come_moving = _one_way(keys, now, before, clear)
    return VoxelScores(
        keys=keys,
        appeared=appeared,
        disappeared=disappeared,
        judged=gone_judged | come_judged,
        moving=gone_moving | come_moving,
        seen_through=np.maximum(gone_through, come_through),
    )


def _one_way(
    keys: Keys, own: Seen, other: Seen, clear: int
) -> tuple[Probabilities, Bools, np.ndarray, Bools]:
    """Return (V,) chance, judged, scans that saw through and moving, of what `own` hit and `other` looked at."""
    there = rows_of(keys, own.keys) >= 0
    seen, itself = other.verdicts(own.points), own.verdicts(own.points)
    changed = (seen.surely > 0) & (seen.surely > seen.confirmed) & ~near(own.keys, other.keys, clear)
    through = np.zeros(len(keys), np.int16)
    through[there] = seen.through
    chance = np.zeros(len(keys), np.float32)
    chance[there] = changed * (1 - 0.4 ** seen.surely.astype(np.float32)).astype(np.float32)
    judged, moving = np.zeros((2, len(keys)), bool)
    judged[there], moving[there] = seen.judged, itself.surely > itself.confirmed
    return chance, judged, through, moving
