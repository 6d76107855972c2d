"""The loss (paper, Section 3.7)."""

from __future__ import annotations

import torch
from torch import Tensor

ALPHA = (0.25, 0.35, 0.40)  #: against the classes' shares of 50, 35 and 15%
GAMMA = 2.0
ORTHOGONALITY = 0.001


def total_loss(logits: Tensor, labels: Tensor, transforms: tuple[Tensor, ...]) -> Tensor:
    """Return focal loss and the T-Nets' orthogonality, L = L_focal + 0.001 L_ortho."""
    return focal_loss(logits, labels) + ORTHOGONALITY * orthogonality(transforms)


def focal_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Return mean of -alpha_c (1 - p_c)^2 log p_c over (B, 3) logits, c the true class of each of (B,) labels."""
    log_p = logits.float().log_softmax(dim=1).gather(1, labels[:, None])[:, 0]  # (B,)
    alpha = torch.tensor(ALPHA, device=logits.device)[labels]
    return -(alpha * (1 - log_p.exp()) ** GAMMA * log_p).mean()


def orthogonality(transforms: tuple[Tensor, ...]) -> Tensor:
    """Return |I - A A'|^2 (Frobenius), averaged over the batch and over the T-Nets' matrices, each (B, k, k)."""
    losses = []
    for matrix in transforms:
        matrix = matrix.float()  # noqa: PLW2901
        identity = torch.eye(matrix.shape[1], device=matrix.device)
        losses.append((identity - matrix @ matrix.transpose(1, 2)).square().sum(dim=(1, 2)).mean())
    return torch.stack(losses).mean()
