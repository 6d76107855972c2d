"""Fusing the same scans over and over, a few of them changed, so that untouched voxels come out bit for bit the same."""

from __future__ import annotations

from collections.abc import Sequence

from worker.pipeline.voxels import Voxels


def fused(scans: Sequence[Voxels]) -> Voxels:
    """All scans together, summed in an order that depends on their places alone.

    `worker.pipeline.mapping.fuse` merges by size, so that one changed scan may change how others are summed, and
    the last bit of a mean with it; every tile would then have to be scored again. Raises ValueError without a scan.
    """
    if not scans:
        raise ValueError("no scan to fuse")
    if len(scans) == 1:
        return scans[0]
    middle = len(scans) // 2
    return fused(scans[:middle]).merged(fused(scans[middle:]))
