"""A network that is not trained but has lived: its normalisation has seen data."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch
from safetensors.torch import save

from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.detectors.card import Card, Preprocessing
from worker.detectors.spicd_net.network import SpicdNetwork


@pytest.fixture(scope="session")
def network() -> SpicdNetwork:
    torch.manual_seed(0)
    net = SpicdNetwork()
    compared = torch.rand(8 * 128, 3)
    with torch.no_grad():
        for parameter in net.parameters():  # away from the identity, so that every layer matters
            parameter.add_(0.02 * torch.randn_like(parameter))
        for _ in range(20):
            net(torch.rand(8 * 200, 3) - 0.5, [200] * 8, compared, [128] * 8)
    return net.eval()


@pytest.fixture
def card() -> Card:
    return Card(
        name="spicd-net",
        version="7",
        detector="spicd-net",
        summary="for tests",
        threshold=0.5,
        preprocessing=Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=64),
        detector_settings={"patch_points": 1024, "seed": 42},
        weights="weights.safetensors",
    )


@pytest.fixture
def model_store(tmp_path, network, card):
    """A store with the one model, spicd-net/7."""
    folder = tmp_path / "spicd-net" / "7"
    folder.mkdir(parents=True)
    content = save(network.state_dict())
    (folder / "weights.safetensors").write_bytes(content)
    signed = card.model_copy(update={"sha256": hashlib.sha256(content).hexdigest()})
    (folder / "card.json").write_text(signed.model_dump_json())
    return tmp_path


@pytest.fixture
def pairs() -> TilePairs:
    """Five tiles in a row, far from the frame's origin; the third was not observed, the fifth is large."""
    rng = np.random.default_rng(5)
    grid = TileGrid(origin=np.array([100.0, 50.0, 0.0]), size=np.array([1.5, 1.5, 1.0]), shape=(5, 1, 1))
    indices = np.array([[i, 0, 0] for i in range(5)], dtype=np.int32)

    def clouds(counts: list[int]) -> tuple[np.ndarray, ...]:
        lower = grid.lower(indices)
        return tuple(
            (lower[i] + rng.uniform(0, 1, (n, 3)) * grid.size).astype(np.float32)
            for i, n in enumerate(counts)
        )

    return TilePairs(
        reference=Tiles(grid=grid, indices=indices, points=clouds([300, 900, 500, 70, 1500])),
        current=clouds([350, 64, 0, 400, 2000]),
        observed=np.array([True, True, False, True, True]),
    )
