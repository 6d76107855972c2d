"""Samples of a simulated room, a short training on them, and the model that comes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from worker.cloud.voxel_keys import offsets, packed, unpacked
from worker.detectors.store import open_detector
from worker.detectors.voxel_net.detector import BLIND, SEEING, VoxelNetSettings
from worker.detectors.voxel_net.sparse import Convolution, pyramid
from worker.simulation.voxel_samples import VoxelSampleSettings, building_samples, make_samples
from worker.training.voxels.publish import calibration_error, logistic_fit, publish
from worker.training.voxels.samples import MISSING, THERE, UNKNOWN, VoxelSample, load_samples
from worker.training.voxels.trainer import VoxelTrainSettings, train_network, train_networks, voxel_loss

SMALL = VoxelSampleSettings(
    buildings={"room": 2}, stops={"room": 3}, edits={"room": 3}, solids={"room": 2}, visits=1, views=6
)
QUICK = VoxelTrainSettings(
    epochs=2, steps=12, crops=2, held_out=2, detector=VoxelNetSettings(widths=(8, 8), head=8)
)


@pytest.fixture(scope="module")
def samples() -> list[VoxelSample]:
    return [sample for number in range(2) for sample in building_samples("room", number, SMALL)]


def test_samples_tell_what_is_missing_from_what_is_not(samples: Sequence[VoxelSample]) -> None:
    labels = np.concatenate([sample.labels for sample in samples])
    assert {int(label) for label in np.unique(labels)} == {UNKNOWN, THERE, MISSING}
    seeing = [sample for sample in samples if sample.free_space]
    assert 0 < len(seeing) < len(samples)
    through = np.concatenate([sample.channels[:, 2] for sample in seeing])  # log(1 + scans that saw through)
    known = np.concatenate([sample.labels for sample in seeing])
    assert through[known == MISSING].mean() > 3 * through[known == THERE].mean()
    blind = [sample for sample in samples if not sample.free_space]
    assert all((sample.channels[:, 2:10] == 0).all() for sample in blind)


def test_samples_are_made_again_alike_and_come_back_from_their_files(
    samples: Sequence[VoxelSample], tmp_path: Path
) -> None:
    make_samples(SMALL, tmp_path, processes=1)
    back = load_samples(tmp_path)
    assert len(back) == len(samples)
    for one, other in zip(back, samples, strict=True):
        assert np.array_equal(one.keys, other.keys)
        assert np.array_equal(one.channels, other.channels)
        assert np.array_equal(one.labels, other.labels)
    written = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    make_samples(SMALL, tmp_path, processes=1)  # nothing is left to do
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == written


class Stopped(Exception):
    pass


def test_a_training_learns_and_goes_on_where_it_stopped(
    samples: Sequence[VoxelSample], tmp_path: Path
) -> None:
    def stop(stage: str, share: float) -> None:
        if share > 0.7:
            raise Stopped

    whole = train_network(SEEING, samples, QUICK, tmp_path / "whole")
    with pytest.raises(Stopped):
        train_network(SEEING, samples, QUICK, tmp_path / "part", stop)
    part = train_network(SEEING, samples, QUICK, tmp_path / "part")
    states = [torch.load(path, weights_only=True) for path in (whole, part)]
    for name, value in states[0]["network"].items():
        assert torch.equal(value, states[1]["network"][name]), name
    labels = np.concatenate(
        [sample.labels for sample in samples if sample.building == 0 and sample.free_space]
    )
    chance = (labels == MISSING).sum() / (labels != UNKNOWN).sum()
    assert states[0]["measured"]["average_precision"] > 1.5 * chance
    assert len((tmp_path / "part" / "epochs-seeing.csv").read_text().splitlines()) == 3
    with pytest.raises(ValueError, match="made with other settings"):
        train_network(SEEING, samples, QUICK.with_values(epochs=1), tmp_path / "whole")


def test_the_loss_leaves_out_what_nobody_knows() -> None:
    labels = torch.tensor([1, 0, -1], dtype=torch.int8)
    right = voxel_loss(torch.tensor([9.0, -9.0, 5.0]), labels, dice=0.3)
    assert float(right) < 0.01
    assert float(right) == float(voxel_loss(torch.tensor([9.0, -9.0, -5.0]), labels, dice=0.3))
    assert float(voxel_loss(torch.tensor([-9.0, 9.0, 0.0]), labels, dice=0.3)) > 5


def test_a_model_is_made_of_both_networks_and_opens(samples: Sequence[VoxelSample], tmp_path: Path) -> None:
    checkpoints = train_networks(samples, QUICK, QUICK, tmp_path / "run")
    folder = publish(checkpoints, samples, tmp_path / "store", summary="a test", command="none")
    detector = open_detector(tmp_path / "store", "voxel-net/1")
    assert folder == tmp_path / "store" / "voxel-net" / "1"
    figures = detector.card.evaluation["held_out"]
    for name in (SEEING, BLIND):
        assert figures[name]["expected_calibration_error"] <= figures[name]["before_calibration"] + 0.01
        assert detector.card.training[name]["best_epoch"]["epoch"] in (1, 2)
    assert detector.card.preprocessing.tiles == "touched"


def test_without_a_sample_of_the_kind_there_is_no_training(
    samples: Sequence[VoxelSample], tmp_path: Path
) -> None:
    blind = [sample for sample in samples if not sample.free_space]
    with pytest.raises(ValueError, match="0 samples to train seeing"):
        train_network(SEEING, blind, QUICK, tmp_path)


def test_a_logistic_curve_is_fitted_and_makes_probabilities_true() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 2, 20_000)
    truth = rng.random(20_000) < 1 / (1 + np.exp(-(1.5 * values - 1)))
    slope, offset = logistic_fit(values, truth)
    assert (slope, offset) == pytest.approx((1.5, -1.0), abs=0.1)
    assert calibration_error(1 / (1 + np.exp(-(slope * values + offset))), truth) < 0.01
    assert calibration_error(np.full(4, 0.9), np.array([True, False, False, False])) == pytest.approx(0.65)


def test_a_sparse_convolution_is_the_dense_one_on_its_cells() -> None:
    rng = np.random.default_rng(1)
    cells = np.unique(rng.integers(0, 5, (40, 3)), axis=0) * 2  # one voxel in each cell of twice the size
    keys = packed(cells)
    (level,) = pyramid(keys, 1)
    layer = Convolution(2, 3)
    features = torch.from_numpy(rng.normal(size=(len(keys), 2)).astype("f4"))
    told = layer(features, level)
    grid = np.zeros((7, 7, 7, 2), np.float32)
    place = unpacked(keys) // 2 + 1
    grid[tuple(place.T)] = features
    weight = layer.weight.detach().numpy().reshape(3, 3, 3, 2, 3)
    assert len(offsets(1)) == 27
    for row, (x, y, z) in enumerate(place):
        window = grid[x - 1 : x + 2, y - 1 : y + 2, z - 1 : z + 2]
        assert told[row].detach().numpy() == pytest.approx(
            np.einsum("abci,abcio->o", window, weight), abs=1e-5
        )


def test_the_gradient_of_a_convolution_is_right() -> None:
    keys = packed(np.unique(np.random.default_rng(0).integers(0, 6, (60, 3)), axis=0))
    (level,) = pyramid(keys, 1)
    layer = Convolution(3, 4).double()
    features = torch.randn(len(level.neighbours), 3, dtype=torch.double, requires_grad=True)
    assert torch.autograd.gradcheck(lambda given: layer(given, level), (features,))
    kept = replace(level)

    def of_weight(weight: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(layer, {"weight": weight}, (features.detach(), kept))

    assert torch.autograd.gradcheck(of_weight, (layer.weight.detach().requires_grad_(),))
