"""The maximum over a cloud's points of a wide layer, on a processor: nine tenths of what a PointNet computes.

Exact, it is the product of all points in float32. Searched, the winner of each output among a piece of points is looked
for with 8 bits, which processors with VNNI multiply four times faster, and its value is computed in float32. So only a
winner that another point of the piece all but equals can be missed, and the value is then that of the other.

Without VNNI such products may be cut off at 16 bits; every processor that has bfloat16 has it
(`worker.detectors.precision.has_bfloat16`).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

Maximum = Callable[[Tensor], Tensor]  #: points (m, inputs) -> (outputs,), the largest output of any point

#: Points of a piece: 1,024 outputs of 256 points are 1 MiB, a core's second-level cache (best of 64 to 4,096). Of 512
#: points a search is a tenth faster and three times coarser.
PIECE = 256

LEAST = 1e-12  #: of a scale, where all that is scaled is 0
INPUT_LEVELS, WEIGHT_LEVELS = 255, 127  #: of uint8, as inputs are rectified; of int8


def exact_maximum(weight: Tensor, piece: int = PIECE) -> Maximum:
    """Return the maximum of `weight` (outputs, inputs) times the points, all of it in float32."""

    def maximum(x: Tensor) -> Tensor:
        parts = torch.split(x, piece if x.device.type == "cpu" else len(x))
        return torch.stack([(weight @ part.t()).amax(dim=1) for part in parts]).amax(dim=0)

    return maximum


def searched_maximum(weight: Tensor) -> Maximum:
    """Return the same maximum with its winners searched in 8 bits; inputs must not be negative, nor the cloud empty."""
    numbers = torch.arange(PIECE, dtype=torch.int32)[:, None]

    def maximum(x: Tensor) -> Tensor:
        inputs, weights = _quantised(x, weight)
        values = []
        for part, coarse in zip(torch.split(x, PIECE), torch.split(inputs, PIECE), strict=True):
            outputs = torch._int_mm(coarse, weights)  # (piece, outputs) int32, below 2^22 for 128 inputs
            # The point's number goes into the low bits, so that one maximum tells value and winner.
            winners = outputs.mul_(PIECE).add_(numbers[: len(part)]).amax(dim=0) & (PIECE - 1)
            values.append((functional.embedding(winners.long(), part) * weight).sum(dim=1))
        return torch.stack(values).amax(dim=0)

    return maximum


def _quantised(x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (m, inputs) uint8 and weights (inputs, outputs) int8, each input and output on a scale of its own.

    An output's scale is the same for all points, so that the winner stays the winner. An input's scale goes into the
    weights.
    """
    largest = x.amax(dim=0).clamp_min_(LEAST)  # (inputs,)
    scaled = weight * largest
    steepest = scaled.abs().amax(dim=1, keepdim=True).clamp_min_(LEAST)
    inputs = (x * (INPUT_LEVELS / largest)).round_().to(torch.uint8)
    weights = (scaled * (WEIGHT_LEVELS / steepest)).round_().to(torch.int8)
    return inputs, weights.t()
