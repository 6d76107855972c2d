"""A model of SPICD-Net with random weights, written as `model_store` holds one."""

from __future__ import annotations

import hashlib
from pathlib import Path


def make_untrained(folder: Path) -> None:
    """Write a model that was never trained to `folder`, which is `model_store/<name>/<version>`."""
    import torch
    from safetensors.torch import save

    from worker.detectors.card import Card, Preprocessing
    from worker.detectors.spicd_net.network import SpicdNetwork

    torch.manual_seed(0)
    weights = save(SpicdNetwork().state_dict())
    card = Card(
        name="spicd-net",
        version="1",
        detector="spicd-net",
        summary="never trained",
        threshold=0.4,
        preprocessing=Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512),
        detector_settings={"patch_points": 4096, "seed": 42},
        weights="weights.safetensors",
        sha256=hashlib.sha256(weights).hexdigest(),
    )
    folder.mkdir(parents=True)
    (folder / "weights.safetensors").write_bytes(weights)
    (folder / "card.json").write_text(card.model_dump_json())
