"""The paper's way, written out: the same scores as ours, from the same points."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worker.benchmarks.plain_inference import plain_scores, written_out
from worker.benchmarks.speed import resized, ways
from worker.cloud.tiling import TileGrid, TilePairs, Tiles
from worker.detectors.card import Card, Preprocessing
from worker.detectors.spicd_net.detector import SpicdNet
from worker.detectors.spicd_net.network import SpicdNetwork

SIZE = 256  #: points of a patch


@pytest.fixture(scope="module")
def network() -> SpicdNetwork:
    """Every layer away from what it starts as, and its normalisation has seen data."""
    torch.manual_seed(0)
    made = SpicdNetwork()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
        for _ in range(10):
            made(torch.rand(4 * 100, 3) - 0.5, [100] * 4, torch.rand(4 * 100, 3), [100] * 4)
    return made.eval()


def detector_of(network: SpicdNetwork, chamfer_points: int | None) -> SpicdNet:
    needs = Preprocessing(
        voxel_size=0.05,
        tile_size=(1.5, 1.5, 1.0),
        patch_points=SIZE,
        chamfer_points=chamfer_points,
        min_points=64,
        seed=42,
    )
    card = Card(
        name="spicd-net",
        version="7",
        detector="spicd-net",
        summary="for tests",
        threshold=0.5,
        preprocessing=needs,
    )
    return SpicdNet(card, network, torch.device("cpu"))


@pytest.fixture
def pairs() -> TilePairs:
    """Three tiles far from the origin, smaller and larger than a patch; the second was not observed."""
    rng = np.random.default_rng(3)
    grid = TileGrid(origin=np.array([70.0, 20.0, 0.0]), size=np.array([1.5, 1.5, 1.0]), shape=(3, 1, 1))
    indices = np.array([[i, 0, 0] for i in range(3)], np.int32)

    def clouds(counts: tuple[int, ...]) -> tuple[np.ndarray, ...]:
        lower = grid.lower(indices)
        return tuple(
            (lower[i] + rng.uniform(0, 1, (n, 3)) * grid.size).astype(np.float32)
            for i, n in enumerate(counts)
        )

    return TilePairs(
        reference=Tiles(grid=grid, indices=indices, points=clouds((100, 200, 500))),
        current=clouds((300, 0, 90)),
        observed=np.array([True, False, True]),
    )


@pytest.mark.parametrize("chamfer_points", [None, 64])
def test_the_plain_way_gives_the_scores_of_ours(network, pairs, chamfer_points):
    detector = detector_of(network, chamfer_points)
    plain, ours = plain_scores(detector, pairs), detector.score(pairs).probabilities
    assert plain == pytest.approx(ours, abs=1e-4, nan_ok=True)
    assert np.isnan(plain).all(axis=1).tolist() == [False, True, False]
    assert abs(plain[0] - plain[2]).max() > 1e-3  # the tiles are told apart, so that equality says something


def test_every_way_of_the_bench_gives_the_same_scores(network, pairs):
    found = {name: run() for name, run in ways(pairs, detector_of(network, None)).items()}
    assert len(found) == 4
    for scores in found.values():
        assert scores == pytest.approx(found["plain"], abs=1e-4, nan_ok=True)


@pytest.mark.parametrize("count", [100, SIZE, 500])
def test_the_patch_written_out_holds_our_points_as_often_as_ours(count):
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (count, 3)).astype(np.float32)
    ours, plain = written_out(points, SIZE, seed=42)
    assert sorted(map(tuple, plain.tolist())) == sorted(map(tuple, ours.padded().tolist()))


def test_the_patch_written_out_goes_from_each_point_to_the_farthest():
    row = np.zeros((5, 3), np.float32)
    row[:, 0] = [0, 1, 2, 3, 10]
    plain = written_out(row, 5, seed=42)[1][:, 0].tolist()
    assert plain[1] == (0 if plain[0] == 10 else 10)


def test_pairs_are_taken_again_until_there_are_as_many_as_asked_for(pairs):
    found = resized(pairs, 5)
    assert [len(points) for points in found.current] == [300, 90, 300, 90, 300]
    assert found.reference.indices[:, 0].tolist() == [0, 2, 0, 2, 0]
    assert found.observed.all()
