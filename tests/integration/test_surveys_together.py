"""Several surveys wait for one inference worker: it scores them together, and each as if it were alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from service.api.http.reading.submission import Ticker
from service.catalog import tallies
from service.catalog.files import blob_keys
from service.catalog.records import JobRecord
from service.dispatch import Dispatcher
from service.queue import JobQueue
from service.settings import Settings
from service.up.embedded_redis import EmbeddedRedis
from service.up.launcher import environment_of
from tests.support.bench import ROOT
from tests.support.house import MODEL, SAME_CUT, House, run
from tests.support.processes import until
from worker.cloud import npz
from worker.detectors.detector import Detection

SURVEYS = 3


@pytest.fixture
def held_model(house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Have the model's weights not there before the test says so: who opens it waits for them."""
    models = tmp_path / "models"
    shutil.copytree(house.material.model_store, models)
    weights = models / MODEL / "weights.safetensors"
    content = weights.read_bytes()
    weights.unlink()
    os.mkfifo(weights)
    monkeypatch.setenv("SPICD_MODEL_STORE", str(models))
    return lambda: (weights.write_bytes(content), None)[1]


@pytest.fixture
def queue(house: House, tmp_path: Path) -> Iterator[JobQueue]:
    """A queue with a real inference worker, of three steps at a time and four tiles a batch."""
    with EmbeddedRedis(tmp_path / "redis") as server:
        settings = Settings(
            redis_url=server.url,
            model=SAME_CUT,  # which is there, so that the worker starts
            inference_concurrency=SURVEYS,
            inference_batch_tiles=4,
            inference_batch_wait_ms=1000,
        )
        queue = JobQueue(server.url)
        command = [sys.executable, "-m", "worker", "inference"]
        worker = subprocess.Popen(command, cwd=ROOT, env=environment_of(settings))
        with Ticker(Dispatcher(house.catalog.jobs, queue), every_s=0.1):
            yield queue
        worker.terminate()
        assert worker.wait(60) == 0
        queue.close()


def scores_of(house: House, job: JobRecord) -> Detection:
    key = blob_keys.survey_scores(str(job.survey_id))
    with house.catalog.blobs.local(key) as path:
        return npz.load(path, kind=Detection)


def figures(house: House) -> dict[str, tuple[int, float]]:
    with house.catalog.database.read() as session:
        samples = tallies.read(session)
    return {sample.name: (sample.count, sample.total) for sample in samples if "inference" in sample.name}


def test_surveys_that_wait_are_scored_together_and_as_if_alone(
    house: House, request: pytest.FixtureRequest, held_model: Callable[[], None]
) -> None:
    scan = house.catalog.scans.get(house.survey(house.done[0]).scans[0].scan_id)
    jobs = [house.survey_of(scan) for _ in range(SURVEYS)]
    for job in jobs:
        run(job, "register")
    queue: JobQueue = request.getfixturevalue("queue")
    until(lambda: len(queue.snapshot()["inference"].claims) == SURVEYS, 180)  # all are in one worker's hands
    held_model()
    scored = partial(house.catalog.blobs.exists)
    until(lambda: all(scored(blob_keys.survey_scores(str(job.survey_id))) for job in jobs), 120)
    alone = scores_of(house, house.done[0])
    for job in jobs:
        found = scores_of(house, job)
        assert np.allclose(found.probabilities, alone.probabilities, atol=1e-5, equal_nan=True)
    until(lambda: queue.snapshot()["inference"].claims == ())
    tiles = int((~np.isnan(alone.change)).sum())
    until(lambda: figures(house).get("spicd_inference_batch_size", (0, 0))[1] == SURVEYS * tiles)
    told = figures(house)
    assert told["spicd_inference_models_opened"] == (1, 1.0)
    batches, steps = told["spicd_inference_batch_steps"]
    assert steps > batches, "no batch had tiles of two surveys"
    assert told["spicd_inference_batch_size"][0] == batches
    assert told["spicd_inference_network_seconds"][0] == batches
    until(lambda: queue.snapshot()["inference"].models == 1)
    assert queue.snapshot()["inference"].model_bytes > 1_000_000
