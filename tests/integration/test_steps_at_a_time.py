"""An inference worker that runs several steps at a time: each has its own claim, time limit and end."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.settings import Settings
from service.up.embedded_redis import EmbeddedRedis
from tests.support.bench import Bench
from tests.support.processes import until


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    settings = Settings(data_dir=tmp_path / "data", inference_concurrency=3)
    with EmbeddedRedis(tmp_path / "redis") as server, Bench(tmp_path, server.url, settings) as bench:
        yield bench


def started(bench: Bench, grace: float = 5) -> subprocess.Popen[bytes]:
    """Start a worker, and wait for its first sign of life: on a busy machine that takes longer than any step."""
    before = set(bench.queue.snapshot()["inference"].answering)
    worker = bench.worker("inference", grace=grace)
    until(lambda: set(bench.queue.snapshot()["inference"].answering) - before, 180)
    return worker


def ended(bench: Bench, job_id: str, status: str = "successful") -> None:
    """Wait for the end of a job; it is as it should be, and nothing of it is left in Redis."""
    until(lambda: bench.job(job_id).status not in ("accepted", "running"), 60)
    assert bench.job(job_id).status == status, bench.job(job_id).problem
    until(lambda: bench.traces(job_id) == [])


def test_so_many_steps_run_at_a_time_and_the_next_when_one_ends(bench: Bench) -> None:
    for number in range(4):
        bench.submit(f"m{number}", ("hold", "inference"), ("finish", "inference"))
    worker = started(bench)
    until(lambda: len(bench.lines("hold")) == 3)
    assert len(bench.claims("inference")) == 3
    assert len({line.split()[2] for line in bench.lines("hold")}) == 1  # one process
    (bench.folder / "go").touch()
    for number in range(4):
        ended(bench, f"m{number}")
    assert len(bench.lines("finish")) == 4
    assert worker.poll() is None
    bench.submit("m9", ("hold", "inference"), ("finish", "inference"))
    ended(bench, "m9")


def test_the_claims_of_all_are_kept_alive(bench: Bench) -> None:
    for number in range(2):
        bench.submit(f"m{number}", ("hold", "inference"), ("finish", "inference"))
    started(bench)
    until(lambda: len(bench.claims("inference")) == 2)
    claims = bench.claims("inference")
    for claim in claims:
        bench.redis.expire(f"rq:execution:{claim}", 8)
    until(lambda: all(int(bench.redis.ttl(f"rq:execution:{claim}")) > 10 for claim in claims))


def test_a_step_whose_time_is_up_ends_and_the_one_beside_it_goes_on(bench: Bench) -> None:
    bench.submit("m1", ("busy", "inference"), timeout_s=1)
    worker = started(bench)
    bench.wait_for("busy m1")
    bench.submit("m2", ("hold", "inference"), ("finish", "inference"))
    ended(bench, "m1", "failed")
    problem = bench.job("m1").problem
    assert problem is not None
    assert problem.code == "timed_out"
    bench.wait_for("hold m2")
    (bench.folder / "go").touch()
    ended(bench, "m2")
    assert worker.poll() is None
    assert len(bench.lines("hold")) == 1  # it was not run a second time


def test_a_step_that_raises_fails_alone(bench: Bench) -> None:
    bench.submit("m1", ("hold", "inference"), ("finish", "inference"))
    started(bench)
    bench.wait_for("hold m1")
    bench.submit("m2", ("refuse", "inference"))
    ended(bench, "m2", "failed")
    problem = bench.job("m2").problem
    assert problem is not None
    assert problem.code == "registration_failed"
    (bench.folder / "go").touch()
    ended(bench, "m1")


def test_a_worker_told_to_stop_lets_steps_end_and_puts_back_those_that_do_not(bench: Bench) -> None:
    bench.submit("m1", ("hold", "inference"), ("finish", "inference"))
    bench.submit("m2", ("busy", "inference"))
    worker = started(bench, grace=1)
    bench.wait_for("hold m1")
    bench.wait_for("busy m2")
    worker.send_signal(signal.SIGTERM)
    bench.wait_for("stopped m1")
    bench.wait_for("stopped m2")
    assert worker.wait(30) == 0
    assert {bench.job(job_id).status for job_id in ("m1", "m2")} <= {"accepted", "running"}
    (bench.folder / "go").touch()
    started(bench)
    ended(bench, "m1")


def test_a_step_that_ends_within_the_grace_is_done(bench: Bench) -> None:
    bench.submit("m1", ("hold", "inference"), ("finish", "inference"))
    worker = started(bench, grace=30)
    bench.wait_for("hold m1")
    worker.send_signal(signal.SIGTERM)
    (bench.folder / "go").touch()
    assert worker.wait(30) == 0
    bench.wait_for("held m1")
    assert bench.lines("stopped") == []


def test_what_a_killed_worker_had_in_hand_is_run_again_all_of_it(bench: Bench) -> None:
    for number in range(3):
        bench.submit(f"m{number}", ("hold", "inference"), ("finish", "inference"))
    worker = started(bench)
    until(lambda: len(bench.lines("hold")) == 3)
    worker.kill()
    worker.wait()
    bench.end_claims("inference")
    (bench.folder / "go").touch()
    started(bench)
    for number in range(3):
        ended(bench, f"m{number}")
    assert len(bench.lines("hold")) == 6
    scratch = bench.settings.scratch_dir()
    until(lambda: [path.name.split(".")[0] for path in scratch.iterdir()] == ["standin"])


def test_a_step_that_does_not_hear_takes_its_worker_along_and_costs_the_others_no_attempt(
    bench: Bench,
) -> None:
    bench.submit("m1", ("deaf", "inference"), timeout_s=1)
    worker = started(bench)
    bench.wait_for("deaf m1")
    bench.submit("m2", ("hold", "inference"), ("finish", "inference"))
    bench.wait_for("hold m2")
    assert worker.wait(60) == 1
    ended(bench, "m1", "failed")
    assert any(line.startswith("interrupted m2") for line in bench.record())
    assert bench.lines("lost") == []
    (bench.folder / "go").touch()
    started(bench)
    ended(bench, "m2")


def test_a_gpu_that_fails_ends_the_worker_and_its_steps_are_run_again_by_the_next(bench: Bench) -> None:
    bench.submit("m1", ("faulty_once", "inference"), ("finish", "inference"))
    worker = started(bench)
    bench.wait_for("faulty_once m1")
    bench.submit("m2", ("hold", "inference"), ("finish", "inference"))
    bench.wait_for("hold m2")
    (bench.folder / "fail").touch()
    assert worker.wait(60) == 1
    told = [line for line in bench.record() if line.startswith("interrupted")]
    assert sorted(line.split()[1] for line in told) == ["m1", "m2"]
    assert any("illegal memory access was encountered)" in line for line in told)
    assert bench.lines("lost") == bench.lines("died") == []
    (bench.folder / "go").touch()
    started(bench)
    ended(bench, "m1")
    ended(bench, "m2")
