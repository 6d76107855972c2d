"""Chamfer statistics of a pair (paper, Section 3.6.3), over all points of both patches or a sample of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from worker.detectors.siamese.parallel import in_groups

STATISTICS = 8


@torch.no_grad()
def chamfer_statistics(references: Sequence[Tensor], currents: Sequence[Tensor]) -> Tensor:
    """Return log(1 + x) of mean, maximum, median and 90th percentile of the nearest distances, both ways.

    B clouds (n, 3) and as many (m, 3), metres, tile-centre frame; the result is (B, 8) float32, the four of
    reference to current first. Two equal clouds give zeros to the bit. No gradient passes.
    """
    pairs = list(zip(references, currents, strict=True))
    on_processor = pairs[0][0].device.type == "cpu"
    parts = in_groups(_statistics, pairs) if on_processor else [_statistics(pairs)]
    return torch.log1p(torch.cat(parts))


@torch.no_grad()
def _statistics(pairs: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """B pairs of clouds -> (B, 8)"""
    ways = (nearest_distances(reference, current) for reference, current in pairs)
    return torch.stack([torch.cat([_summary(there), _summary(back)]) for there, back in ways])


def nearest_distances(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return (n,) from each point of `a` (n, 3) to the nearest of `b` (m, 3), and (m,) the other way; metres.

    A k-d tree does it on the CPU, ten times faster than all pairs (2 ms against 30 for 1,700 points); machines that
    only train may lack SciPy, and a GPU needs none.
    """
    if a.device.type == "cpu":
        try:
            from scipy.spatial import cKDTree  # noqa: PLC0415 (optional where only training runs)
        except ImportError:
            return _all_pairs(a, b)
        here, there = a.numpy(), b.numpy()
        ways = ((there, here), (here, there))
        distances = [cKDTree(tree, balanced_tree=False).query(sought)[0] for tree, sought in ways]
        return torch.from_numpy(distances[0]).float(), torch.from_numpy(distances[1]).float()
    return _all_pairs(a, b)


def _all_pairs(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    # Not by products: they lose the last millimetre, and equal clouds would not be at distance 0.
    distances = torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")  # (n, m)
    return distances.amin(dim=1), distances.amin(dim=0)


def _summary(distances: Tensor) -> Tensor:
    """(n,) -> (4,)"""
    quantiles = torch.quantile(distances, torch.tensor([0.5, 0.9], device=distances.device))
    return torch.cat([distances.mean()[None], distances.amax()[None], quantiles])
