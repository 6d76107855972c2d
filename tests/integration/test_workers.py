"""Real worker processes on a real queue, with steps of their own (standin.py)."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import zlib
from typing import Any
from unittest.mock import Mock

import pytest
from rq import Queue
from rq.serializers import JSONSerializer

from service.catalog import steps
from service.up.launcher import environment_of
from tests.support.bench import ROOT, STANDIN, Bench, add_map
from tests.support.processes import running, until
from worker.__main__ import main
from worker.rq_workers import GeometryWorker


def test_steps_run_in_order_across_the_two_queues(bench: Bench) -> None:
    bench.worker("geometry")
    bench.worker("inference")
    bench.submit("m1", ("first", "geometry"), ("second", "inference"), ("finish", "geometry"))
    bench.wait_for("finish m1")
    assert bench.record() == ["first m1", "second m1", "finish m1"]
    until(lambda: bench.traces("m1") == [])
    assert bench.job("m1").status == "successful"


def test_a_step_that_raises_ends_its_job_and_leaves_nothing_waiting(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("refuse", "geometry"), ("second", "geometry"), ("third", "inference"))
    until(lambda: bench.job("m1").status == "failed")
    problem = bench.job("m1").problem
    assert problem is not None
    assert problem.code == "registration_failed"
    until(lambda: bench.traces("m1") == [])
    bench.submit("m2", ("first", "geometry"))
    bench.wait_for("first m2")
    assert not any(line.startswith(("second", "third")) for line in bench.record())


def test_a_dismissed_step_is_killed_and_the_worker_goes_on(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("sleep", "geometry"), ("second", "geometry"))
    pid = int(bench.wait_for("sleep m1")[2])
    bench.jobs.dismiss("m1")
    bench.queue.dismiss("m1", "map")
    until(lambda: not running(pid))
    bench.submit("m2", ("first", "geometry"))
    bench.wait_for("first m2")
    assert not any("m1" in line and not line.startswith("sleep") for line in bench.record())


@pytest.mark.parametrize("kind", ["geometry", "inference"])
def test_a_function_that_is_not_ours_is_never_called(bench: Bench, kind: steps.Queue) -> None:
    trace = bench.folder / "trace"
    worker = bench.worker(kind)
    queue = Queue(kind, connection=bench.redis, serializer=JSONSerializer)
    until(lambda: bench.redis.scard(f"rq:workers:{kind}"))
    forged = queue.enqueue("os.system", f"touch {trace}", job_id="m1-forged")
    bench.submit("m2", ("first", kind))
    bench.wait_for("first m2")
    assert not bench.redis.exists(forged.key)
    assert not trace.exists()
    assert worker.poll() is None


def test_a_callback_that_a_job_names_is_not_called(bench: Bench) -> None:
    bench.submit("m1", ("hold", "geometry"), ("first", "geometry"))
    until(lambda: bench.redis.exists("rq:job:m1-hold"))
    leak = f"{STANDIN}.leak"
    callback: dict[Any, Any] = {"success_callback_name": leak, "failure_callback_name": leak}
    bench.redis.hset("rq:job:m1-hold", mapping=callback)
    (bench.folder / "go").touch()
    bench.worker("geometry")
    bench.wait_for("first m1")
    assert bench.names() == ["hold", "held", "first"]


def test_a_stop_that_comes_when_the_step_is_over_kills_nobody(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed: list[int] = []
    monkeypatch.setattr(os, "killpg", lambda group, number: killed.append(group))
    monkeypatch.setattr(os, "kill", lambda pid, number: killed.append(pid))
    worker = GeometryWorker("geometry", bench.redis, allowed=frozenset(), records=Mock(), grace_s=1)
    worker.kill_horse()
    assert killed == []


@pytest.mark.parametrize("kind", ["geometry", "inference"])
def test_a_step_that_takes_too_long_is_ended_and_says_so(bench: Bench, kind: steps.Queue) -> None:
    worker = bench.worker(kind)
    bench.submit("m1", ("busy", kind), timeout_s=1)
    until(lambda: bench.job("m1").status == "failed")
    problem = bench.job("m1").problem
    assert problem is not None
    assert problem.code == "timed_out"
    bench.submit("m2", ("first", kind))
    bench.wait_for("first m2")
    assert worker.poll() is None


def test_the_real_worker_writes_what_it_refused_into_the_catalog(bench: Bench) -> None:
    job_id = add_map(bench.catalog)
    until(lambda: bench.redis.exists(f"rq:job:{job_id}-register"))
    forged: dict[Any, Any] = {
        "created_at": "2026-03-01T12:00:00Z",
        "data": zlib.compress(json.dumps(["os.system", None, [job_id], {}]).encode()),
    }
    bench.redis.hset(f"rq:job:{job_id}-register", mapping=forged)
    command = [sys.executable, "-m", "worker", "geometry"]
    bench.workers.append(subprocess.Popen(command, cwd=ROOT, env=environment_of(bench.settings)))
    until(lambda: bench.job(job_id).status == "failed", 60)
    problem = bench.job(job_id).problem
    assert problem is not None
    assert problem.code == "function_refused"
    assert "os.system" in problem.detail
    assert bench.catalog.maps.get("lobby").status == "failed"


def test_an_idle_worker_told_to_stop_ends_at_once(bench: Bench) -> None:
    worker = bench.worker("inference")
    bench.submit("m1", ("finish", "inference"))
    bench.wait_for("finish m1")
    until(lambda: bench.traces("m1") == [])
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(15) == 0


def test_a_working_inference_worker_keeps_its_claim_alive(bench: Bench) -> None:
    bench.worker("inference")
    bench.submit("m1", ("busy", "inference"))
    until(lambda: bench.redis.zcard("rq:wip:inference") == 1)
    (claim,) = bench.claims("inference")
    bench.redis.expire(f"rq:execution:{claim}", 8)
    until(lambda: int(bench.redis.ttl(f"rq:execution:{claim}")) > 10)


def test_a_health_check_tells_whether_a_worker_of_this_host_answers(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SPICD_REDIS_URL", bench.redis_url)
    monkeypatch.setattr("socket.gethostname", lambda: "host-1")
    assert main(["alive", "geometry"]) == 1
    assert "no geometry worker of host-1 answers" in capsys.readouterr().err
    bench.worker("geometry", name="geometry-host-2-1")
    until(lambda: bench.redis.scard("rq:workers:geometry") == 1)
    assert main(["alive", "geometry"]) == 1
    bench.worker("geometry", name="geometry-host-1-1")
    until(lambda: main(["alive", "geometry"]) == 0)
    assert main(["alive", "inference"]) == 1
    monkeypatch.setenv("SPICD_REDIS_URL", "redis://127.0.0.1:1")
    assert main(["alive", "geometry"]) == 0  # workers outlive Redis
