"""`python -m worker`: what it does before it works."""

from __future__ import annotations

import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from service.catalog import tallies
from service.catalog.catalog import open_catalog
from service.dispatch import Dispatcher
from service.errors import DatabaseUnavailable
from service.settings import Settings
from worker.__main__ import CatalogRecords, main
from worker.detectors.running.meter import Meter


def test_what_a_worker_writes_is_its_owners_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPICD_REDIS_URL", raising=False)
    before = os.umask(0o022)
    try:
        assert main(["geometry"]) == 2  # there is no queue to work on
        assert os.umask(0o022) == 0o077
    finally:
        os.umask(before)


def test_a_precision_that_the_device_lacks_is_told_before_any_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SPICD_DEVICE", "cpu")
    monkeypatch.setenv("SPICD_INFERENCE_PRECISION", "bfloat16")
    monkeypatch.setattr("worker.detectors.precision.has_bfloat16", lambda device: True)
    assert main(["check", "inference"]) == 0
    monkeypatch.setattr("worker.detectors.precision.has_bfloat16", lambda device: False)
    assert main(["check", "inference"]) == 2
    assert "SPICD_INFERENCE_PRECISION is bfloat16" in capsys.readouterr().err
    assert main(["check", "geometry"]) == 0


def test_a_worker_that_is_started_again_after_its_gpu_was_lost_takes_no_step(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Who starts workers looked for the GPU once; each step would fail for good where it is gone since."""
    monkeypatch.setenv("SPICD_DEVICE", "cuda")
    monkeypatch.setenv("SPICD_REDIS_URL", "redis://127.0.0.1:1")
    monkeypatch.setattr("worker.__main__.end_with_parent", lambda parent: None)
    monkeypatch.setattr("worker.jobs.models.finds_gpu", lambda: False)
    monkeypatch.setattr("worker.__main__.serving", Mock(side_effect=AssertionError("it began to work")))
    before = os.umask(0o022)
    try:
        assert main(["inference", "--parent", "1"]) == 2
    finally:
        os.umask(before)
    assert "torch finds no CUDA GPU" in capsys.readouterr().err


def test_what_networks_counted_is_written_and_kept_where_it_cannot_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(data_dir=tmp_path, redis_url="redis://127.0.0.1:1")
    catalog = open_catalog(settings)
    meter = Meter()
    records = CatalogRecords(settings, counted=meter)
    monkeypatch.setattr(Dispatcher, "run", lambda _: None)
    meter.add("batch_size", "m/1", 12.0)
    records.tick()
    records.tick()
    meter.add("batch_size", "m/1", 3.0)
    with monkeypatch.context() as patch:
        patch.setattr("worker.__main__.tally_inference", Mock(side_effect=DatabaseUnavailable("away")))
        with pytest.raises(DatabaseUnavailable):
            records.tick()
    records.tick()
    with catalog.database.read() as session:
        found = [(sample.name, sample.count, sample.total) for sample in tallies.read(session)]
    catalog.close()
    assert found == [("spicd_inference_batch_size", 2, 15.0)]
