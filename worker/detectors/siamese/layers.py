"""Linear layers with batch normalisation, folded into one product, and the pooled one.

Nine tenths of the network's work is in three 128 -> 1024 layers that are max-pooled at once. Written out,
each makes a (P, 1024) array several times over. Two identities avoid that, in training as in use:

- Batch statistics of `W x` follow from the mean and covariance of `x`: mean `W m`, variance `diag(W C W')`.
  So normalisation folds into the weight before the product, and `relu(W' x + b')` is all that is computed.
- Behind a max-pool only the winning point of each channel matters, forward and backward. The winners are
  searched for without a gradient; the layer then runs on them alone.

Both give the values and gradients of the written-out layer (a test compares them).

Clouds of different sizes lie end to end, (P, C) with the sizes beside, so that none is padded.
"""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

MOMENTUM = 0.1
EPSILON = 1e-5


class NormedLinear(nn.Module):
    """Linear without bias, then batch normalisation over all leading dimensions."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, inputs))
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5))
        self.gamma = nn.Parameter(torch.ones(outputs))
        self.beta = nn.Parameter(torch.zeros(outputs))
        self.register_buffer("running_mean", torch.zeros(outputs))
        self.register_buffer("running_var", torch.ones(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs), in the precision of `x`"""
        weight, bias = self.folded(x)
        return functional.linear(x, weight.to(x.dtype), bias.to(x.dtype))

    def folded(self, x: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return weight (outputs, inputs) and bias (outputs,) with the normalisation in them.

        In training the statistics are those of `x` (..., inputs), which is then needed; otherwise the running
        ones.
        """
        if self.training:
            if x is None:
                raise ValueError("training needs the batch to normalise by")
            mean, var = self._batch_moments(x)
        else:
            mean, var = self.running_mean, self.running_var
        scale = self.gamma * torch.rsqrt(var + EPSILON)
        return self.weight * scale[:, None], self.beta - mean * scale

    def _batch_moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        rows = x.reshape(-1, x.shape[-1])
        mean_in, covariance = Moments.apply(rows)  # type: ignore[no-untyped-call]
        mean = self.weight @ mean_in
        var = ((self.weight @ covariance) * self.weight).sum(1).clamp_min(0)
        with torch.no_grad():
            unbiased = var * (len(rows) / max(len(rows) - 1, 1))
            self.running_mean.lerp_(mean, MOMENTUM)
            self.running_var.lerp_(unbiased, MOMENTUM)
        return mean, var


class Moments(torch.autograd.Function):
    """Mean (C,) and covariance (C, C) of rows (P, C), with the one product that their gradient takes.

    Of rows in bfloat16 both are float32.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor) -> tuple[Tensor, Tensor]:
        exact = torch.promote_types(rows.dtype, torch.float32)
        mean = rows.mean(0, dtype=exact)
        # Inputs are centred points or rectified unit-variance features, so this difference loses little.
        covariance = (rows.t() @ rows).to(exact) / len(rows) - mean[:, None] * mean
        ctx.save_for_backward(rows, mean)
        return mean, covariance

    @staticmethod
    def backward(ctx: Any, of_mean: Tensor, of_covariance: Tensor) -> Tensor:
        rows, mean = ctx.saved_tensors
        pull = (of_covariance + of_covariance.t()) / len(rows)
        push = of_mean / len(rows) - pull @ mean
        return torch.addmm(push.to(rows.dtype), rows, pull.to(rows.dtype))


class PooledLinear(NormedLinear):
    """NormedLinear and a maximum over the points, without ever holding every point's output.

    `coarse_search` looks for the winners in bfloat16, which a recent CPU does three times faster; the values
    and gradients at the winners stay float32. Only for training: outside it the search is exact.
    """

    coarse_search = False

    def forward(self, x: Tensor, sizes: list[int]) -> Tensor:  # type: ignore[override]
        """(P, inputs), B clouds of the given sizes end to end -> (B, outputs)"""
        weight, bias = self.folded(x)
        winners = self._winners(x.detach(), sizes, weight.detach())  # (B, outputs), rows of x
        picked = functional.embedding(winners, x)  # (B, outputs, inputs)
        return torch.einsum("boi,oi->bo", picked, weight) + bias

    def _winners(self, x: Tensor, sizes: list[int], weight: Tensor) -> Tensor:
        if self.training and self.coarse_search:
            x, weight = x.bfloat16(), weight.bfloat16()
        # One cloud at a time: its (outputs, n) product stays in the cache.
        clouds = zip(torch.split(x, sizes), accumulate(sizes, initial=0), strict=False)
        return torch.stack([(weight @ cloud.t()).max(dim=1).indices + start for cloud, start in clouds])
