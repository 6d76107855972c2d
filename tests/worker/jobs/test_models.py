"""What the steps of an inference worker share, by the settings and by whether there is a GPU."""

from __future__ import annotations

import pytest

from service.settings import Settings
from worker.detectors.running.calls import DirectBatches
from worker.detectors.running.shared import SharedBatches
from worker.jobs import models
from worker.jobs.models import networks


@pytest.mark.parametrize(
    ("gpu", "asked", "concurrency", "kind"),
    [
        (False, None, 1, DirectBatches),
        (True, None, 4, SharedBatches),
        (False, 3, 3, SharedBatches),
        (True, 1, 1, DirectBatches),
    ],
)
def test_a_processor_runs_one_step_at_a_time_and_a_gpu_several(
    monkeypatch: pytest.MonkeyPatch, gpu: bool, asked: int | None, concurrency: int, kind: type
) -> None:
    monkeypatch.setattr(models, "finds_gpu", lambda: gpu)
    shared = networks(Settings(inference_concurrency=asked))
    assert shared.concurrency == concurrency
    assert isinstance(shared.runtime.batches, kind)


def test_they_are_made_once_and_have_the_precision_that_is_asked_for() -> None:
    settings = Settings(device="cpu", inference_precision="float32")
    assert networks(settings) is networks(settings)
    assert networks(settings).runtime.precision == "float32"
    assert networks(settings).tells() == {"models": 0, "model_bytes": 0}


def test_a_worker_that_leaves_the_gpu_alone_takes_one_step_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "finds_gpu", lambda: True)
    assert networks(Settings(device="cpu")).concurrency == 1
