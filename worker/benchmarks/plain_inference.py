"""The paper's way of scoring with nothing spared, for `make bench` to hold ours against (Sections 3.4, 3.6 and 3.9).

Every tile of both branches, the reference's too: farthest point sampling in NumPy, the patch written out in full, and
the network layer by layer over all of its points. The same weights, and the same scores within float32 rounding.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from worker.cloud.patches import Patch, farthest_points_numpy, patch
from worker.cloud.tiling import TilePairs
from worker.cloud.types import Points
from worker.detectors.card import Preprocessing
from worker.detectors.spicd_net.detector import CURRENT, REFERENCE, TILES_PER_REPORT, SpicdNet
from worker.detectors.spicd_net.layers import EPSILON
from worker.detectors.spicd_net.network import PairHead
from worker.detectors.store import Weights
from worker.progress import Progress, no_progress


@torch.inference_mode()
def plain_scores(
    detector: SpicdNet, pairs: TilePairs, progress: Progress = no_progress
) -> NDArray[np.float32]:
    """(T, 3) probabilities, one pair after the other; NaN where not observed."""
    weights, needs = detector.weights(), detector.card.preprocessing
    head = _head(weights)
    centres = pairs.reference.grid.centers(pairs.reference.indices)
    probabilities = np.full((len(pairs.observed), 3), np.nan, dtype=np.float32)
    for tile in np.flatnonzero(pairs.observed).tolist():
        if tile % TILES_PER_REPORT == 0:
            progress("score", tile / len(pairs.observed))
        sides = [
            (points[tile] - centres[tile]).astype(np.float32)
            for points in (pairs.reference.points, pairs.current)
        ]
        probabilities[tile] = _scored(sides[0], sides[1], weights, head, needs)
    return probabilities


def written_out(points: Points, size: int, seed: int) -> tuple[Patch, Points]:
    """The patch of `worker.cloud.patches` for a tile (n, 3), and its (size, 3) points in the order of NumPy's sampling.

    Sampling that keeps every point of a small tile decides nothing but their order, so our patch runs none; here it
    runs, at its full price. Which points are then taken once more to fill the patch is as in ours: the centroid
    depends on it, and with it every score. A large tile is sampled from the point that ours begins with.
    """
    ours = patch(points, size=size, seed=seed)
    if len(points) > size:
        start = int(np.flatnonzero((points == ours.distinct[0]).all(axis=1))[0])
        return ours, points[farthest_points_numpy(points, size, start=start)]
    order = farthest_points_numpy(ours.distinct, len(ours.distinct), start=0)
    return ours, np.repeat(ours.distinct[order], ours.repeats[order], axis=0)


def _scored(
    reference: Points, current: Points, weights: Weights, head: PairHead, needs: Preprocessing
) -> NDArray[np.float32]:
    """Both sides of a pair, (n, 3) and (m, 3), metres, tile-centre frame -> (3,)"""
    device = weights["encoder.mlp1.weight"].device
    patches, clouds = zip(
        *(written_out(side, needs.patch_points, needs.seed) for side in (reference, current)), strict=True
    )
    centred = np.stack([cloud - cloud.mean(axis=0) for cloud in clouds])
    descriptors = _encoded(weights, torch.from_numpy(centred).to(device))  # (2, N, 3) -> (2, 1024)
    compared = [
        _compared(patch, stream, needs).to(device)
        for patch, stream in zip(patches, (REFERENCE, CURRENT), strict=True)
    ]
    logits: Tensor = head(descriptors[:1], descriptors[1:], _chamfer(*compared)[None])  # (1, 3)
    probabilities: NDArray[np.float32] = logits.softmax(dim=1)[0].cpu().numpy()
    return probabilities


def _encoded(weights: Weights, x: Tensor) -> Tensor:
    """(B, N, 3) -> (B, 1024), every array in between as large as the formulas say."""
    x = x @ _transform(weights, "encoder.input_transform", x)
    for layer in ("encoder.mlp1", "encoder.mlp2"):
        x = functional.relu(_normed(weights, layer, x))  # (B, N, 64)
    x = x @ _transform(weights, "encoder.feature_transform", x)
    x = functional.relu(_normed(weights, "encoder.mlp3", x))  # (B, N, 128)
    return _normed(weights, "encoder.mlp4", x).amax(dim=1)  # (B, N, 1024) -> (B, 1024)


def _transform(weights: Weights, name: str, x: Tensor) -> Tensor:
    """A T-Net: (B, N, k) -> (B, k, k)"""
    k = x.shape[-1]
    for layer in ("points1", "points2", "pooled"):
        x = functional.relu(_normed(weights, f"{name}.{layer}", x))
    x = x.amax(dim=1)  # (B, N, 1024) -> (B, 1024)
    for layer in ("global1", "global2"):
        x = functional.relu(_normed(weights, f"{name}.{layer}", x))
    matrix = functional.linear(x, weights[f"{name}.matrix.weight"], weights[f"{name}.matrix.bias"])
    return matrix.view(-1, k, k)


def _normed(weights: Weights, name: str, x: Tensor) -> Tensor:
    """Linear, then batch normalisation as in evaluation: (..., inputs) -> (..., outputs)"""
    product = functional.linear(x, weights[f"{name}.weight"])
    normed = functional.batch_norm(
        product.flatten(0, -2),
        weights[f"{name}.running_mean"],
        weights[f"{name}.running_var"],
        weights[f"{name}.gamma"],
        weights[f"{name}.beta"],
        eps=EPSILON,
    )
    return normed.view_as(product)


def _head(weights: Weights) -> PairHead:
    head = PairHead()
    head.load_state_dict(
        {name.removeprefix("head."): each for name, each in weights.items() if name.startswith("head.")}
    )
    return head.to(weights["encoder.mlp1.weight"].device).eval()


def _compared(ours: Patch, stream: int, needs: Preprocessing) -> Tensor:
    """What the Chamfer branch sees of a patch, as the card asks for it: (n, 3)"""
    if needs.chamfer_points is None:
        return torch.from_numpy(ours.distinct)
    rng = np.random.default_rng((needs.seed, stream))
    return torch.from_numpy(ours.at(rng.choice(needs.patch_points, needs.chamfer_points, replace=False)))


def _chamfer(reference: Tensor, current: Tensor) -> Tensor:
    """(n, 3) and (m, 3) -> (8,), of all n x m distances."""
    distances = torch.cdist(reference, current, compute_mode="donot_use_mm_for_euclid_dist")
    quantiles = torch.tensor([0.5, 0.9], device=distances.device)
    found = []
    for nearest in (distances.amin(dim=1), distances.amin(dim=0)):
        found += [nearest.mean()[None], nearest.amax()[None], torch.quantile(nearest, quantiles)]
    return torch.log1p(torch.cat(found))
