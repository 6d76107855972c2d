"""API, Redis and workers on one folder, killed and started again: the jobs of the catalog go on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.api.app import create_app
from service.catalog import tables
from service.catalog.steps import Queue
from service.up.embedded_redis import EmbeddedRedis
from tests.support.bench import Bench, add_map
from tests.support.processes import running, until
from tests.support.samples import catalog_of, settings_in

STEPS: tuple[tuple[str, Queue], ...] = (("hold", "geometry"), ("finish", "geometry"))


class Service:
    """The service with steps of a test's own; each part can be ended alone."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.settings = folder, settings_in(folder)
        self.redis = EmbeddedRedis(folder / "redis")
        self.redis.start()
        self.bench = Bench(folder, self.redis.url, self.settings.resolved_database_url())
        self.open_api()

    def open_api(self, steps: tuple[tuple[str, Queue], ...] = STEPS) -> None:
        self.queue = self.bench.queue(*steps)
        self.api = TestClient(create_app(self.settings, queue=self.queue), base_url="http://localhost")
        self.api.__enter__()

    def close_api(self) -> None:
        self.api.__exit__(None, None, None)

    def new_job(self) -> str:
        job_id = add_map(catalog_of(self.api))
        self.queue.submit(job_id, "map")
        return job_id

    def job(self, job_id: str) -> dict[str, Any]:
        document: dict[str, Any] = self.api.get(f"/jobs/{job_id}").json()
        return document

    def attempts(self, job_id: str) -> int:
        with catalog_of(self.api).database.read() as session:
            return session.scalars(select(tables.Job.attempts).where(tables.Job.job_id == job_id)).one()

    def await_end(self, job_id: str, status: str = "successful") -> None:
        until(lambda: self.job(job_id)["status"] in ("successful", "failed"))
        assert self.job(job_id)["status"] == status

    def stop(self, worker: subprocess.Popen[bytes], how: signal.Signals) -> None:
        """All of it, and start Redis again, as the launcher does."""
        self.close_api()
        worker.send_signal(how)
        worker.wait(15)
        os.kill(self.redis.pid, how)
        until(lambda: not self.redis.alive)
        self.redis.stop()

    def start_redis(self) -> None:
        self.redis.start()
        self.bench.redis.close()
        self.bench = Bench(self.folder, self.redis.url, self.settings.resolved_database_url())
        self.bench.queue(*STEPS).release_claims()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    workers = service.bench.workers
    yield service
    for worker in [*workers, *service.bench.workers]:
        worker.kill()
        worker.wait()
    service.close_api()
    service.redis.stop()


@pytest.mark.parametrize("redis", ["kept its data", "lost its data"])
def test_a_job_that_ran_when_everything_was_killed_goes_on_at_the_next_start(
    service: Service, redis: str
) -> None:
    worker = service.bench.worker("geometry")
    job_id = service.new_job()
    service.bench.wait_for("hold")
    service.stop(worker, signal.SIGKILL)
    if redis == "lost its data":
        shutil.rmtree(service.folder / "redis")
    service.start_redis()
    service.open_api()
    job = service.job(job_id)
    assert (job["status"], job["message"]) == (
        "running",
        "started again (2 of 3): the service ended while it ran",
    )
    (service.folder / "go").touch()
    service.bench.worker("geometry")
    service.await_end(job_id)
    assert service.bench.names() == ["hold", "hold", "held", "finish"]
    assert service.attempts(job_id) == 1


def test_a_job_that_ran_when_everything_was_stopped_goes_on_and_lost_no_attempt(service: Service) -> None:
    worker = service.bench.worker("geometry", grace=0.3)
    job_id = service.new_job()
    service.bench.wait_for("hold")
    service.stop(worker, signal.SIGTERM)
    service.start_redis()
    service.open_api()
    assert service.job(job_id)["status"] == "running"
    (service.folder / "go").touch()
    service.bench.worker("geometry")
    service.await_end(job_id)
    assert service.attempts(job_id) == 0


def test_a_step_that_a_living_worker_has_is_not_run_twice_when_the_api_starts_again(service: Service) -> None:
    service.bench.worker("geometry")
    service.bench.worker("geometry")
    job_id = service.new_job()
    service.bench.wait_for("hold")
    for _ in range(2):
        service.close_api()
        service.open_api()
    assert service.attempts(job_id) == 0
    (service.folder / "go").touch()
    service.await_end(job_id)
    assert service.bench.names() == ["hold", "held", "finish"]


def test_a_step_whose_worker_died_just_now_is_left_to_the_next_worker(service: Service) -> None:
    worker = service.bench.worker("geometry")
    job_id = service.new_job()
    service.bench.wait_for("hold")
    service.close_api()
    worker.kill()
    worker.wait()
    service.open_api()
    assert service.attempts(job_id) == 0
    service.bench.end_claims("geometry")
    (service.folder / "go").touch()
    service.bench.worker("geometry")
    service.await_end(job_id)
    assert service.attempts(job_id) == 1


def test_a_step_that_is_killed_once_says_so_and_ends_well(service: Service) -> None:
    service.bench.worker("geometry")
    job_id = service.new_job()
    pid = int(service.bench.wait_for("hold")[2])
    os.kill(pid, signal.SIGKILL)
    until(lambda: service.bench.names().count("hold") == 2)
    message = str(service.job(job_id)["message"])
    assert message.startswith("started again (2 of 3): ")
    assert "SIGKILL" in message
    (service.folder / "go").touch()
    service.await_end(job_id)


def test_a_file_that_crashes_every_attempt_fails_its_job_and_names_their_number(service: Service) -> None:
    service.close_api()
    service.open_api((("crash", "geometry"), ("finish", "geometry")))
    service.bench.worker("geometry")
    job_id = service.new_job()
    service.await_end(job_id, "failed")
    problem = service.job(job_id)["problem"]
    assert problem["type"] == "urn:spicd:problem:worker_died"
    assert "3 attempts" in problem["detail"]
    assert service.bench.names() == ["crash"] * 3


def test_a_dismissed_job_is_not_started_again_where_the_queue_was_not_told(service: Service) -> None:
    service.bench.worker("geometry")
    job_id = service.new_job()
    pid = int(service.bench.wait_for("hold")[2])
    catalog_of(service.api).jobs.dismiss(job_id)
    os.kill(pid, signal.SIGKILL)
    until(lambda: not running(pid))
    until(lambda: service.bench.redis.hget(f"rq:job:{job_id}-hold", "status") == b"failed")
    assert service.bench.names() == ["hold"]
    assert not service.queue.holds(job_id, "map")
    assert service.job(job_id)["status"] == "dismissed"
