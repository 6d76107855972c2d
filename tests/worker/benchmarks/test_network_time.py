"""The network's time beside its floor: what counts as an operation, and that each way of running it runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from worker.benchmarks.network_time import NetworkTimeSettings, measure, operations, table
from worker.cli import main
from worker.detectors.spicd_net.network import SpicdNetwork


def test_the_operations_are_two_for_each_weight_that_a_point_meets() -> None:
    transforms = (3 * 64 + 64 * 128 + 128 * 1024) + (64 * 64 + 64 * 128 + 128 * 1024)
    layers = 3 * 64 + 64 * 64 + 64 * 128 + 128 * 1024
    encoder = SpicdNetwork().encoder
    assert operations(encoder, points=10, tiles=3) == 2 * 30 * (transforms + layers)
    assert operations(encoder, points=4096, tiles=172) == pytest.approx(0.601e12, rel=1e-3)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_network_is_timed_beside_its_floor(compiled: bool) -> None:
    settings = NetworkTimeSettings(
        device="cpu", tiles=3, points=64, batch=2, repeats=2, square=64, compiled=compiled, backend="eager"
    )
    figures = measure(settings)
    assert figures["network_ms"]["least"] > 0
    assert figures["floor_ms"] == pytest.approx(
        1000 * figures["operations"] / (1e12 * figures["rate_tflops"])
    )
    assert figures["times_floor"] == pytest.approx(figures["network_ms"]["median"] / figures["floor_ms"])
    assert figures["settings"]["compiled"] is compiled
    assert json.dumps(figures, allow_nan=False)
    assert table(figures).row_count == 4


@pytest.mark.skipif(torch.cuda.is_available(), reason="here there is one")
def test_graphs_need_a_gpu_and_the_command_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bench-network", "--device", "cpu", "--graphs", "--out", str(tmp_path / "network.json")])
    assert ended.value.code == 1
    assert "CUDA graphs need a GPU" in capsys.readouterr().err
