"""How precisely a network's large products are computed: float32, or bfloat16 where the device and the model allow it.

bfloat16 has the range of float32 and 8 bits of it; processors that have it add the products up in float32. How far the
scores of a model move is measured (`spicd-worker evaluate precision`) and stands in its card.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Literal

import torch

from worker.errors import DetectorUnavailable

Precision = Literal["float32", "bfloat16"]  #: what is computed with
PrecisionChoice = Literal["auto", "float32", "bfloat16"]  #: what is asked for


def has_bfloat16(device: torch.device) -> bool:
    """Tell whether a device multiplies in bfloat16 by itself: GPUs since Ampere, processors with AVX512-BF16 or AMX.

    Emulation does not count: it is slower than float32.
    """
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    if device.type == "cpu":
        looks = (getattr(torch.cpu, f"_is_{name}_supported", None) for name in ("avx512_bf16", "amx_tile"))
        return any(look() for look in looks if look is not None)
    return False


def chosen_precision(asked: PrecisionChoice, device: torch.device, *, holds: bool) -> Precision:
    """Return what to compute with; `auto` is bfloat16 where the scores hold (`holds`) and the device has it.

    Raises DetectorUnavailable where bfloat16 is asked for of a device that has it not.
    """
    if asked == "auto":
        return "bfloat16" if holds and has_bfloat16(device) else "float32"
    if asked == "bfloat16" and not has_bfloat16(device):
        raise DetectorUnavailable(
            f"bfloat16 is asked for, and device {device.type} does not have it; set SPICD_INFERENCE_PRECISION to auto"
        )
    return asked


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[object]:
    """Return a block within which torch computes products of matrices in this precision (torch.autocast).

    What autocast leaves alone, sums, norms and softmax, stays float32. With float32 the block does nothing.
    """
    if precision == "float32":
        return nullcontext()
    return torch.autocast(device.type, dtype=torch.bfloat16)
