"""Steps that end without a word, with real processes: what is started again, and what is not."""

from __future__ import annotations

import os
import signal
import time

import pytest

from service.catalog.steps import Queue
from tests.support.bench import Bench
from tests.support.processes import running, until


def test_a_step_that_crashes_every_time_is_given_up_after_three_and_the_worker_goes_on(bench: Bench) -> None:
    worker = bench.worker("geometry")
    bench.submit("m1", ("crash", "geometry"), ("second", "geometry"))
    until(lambda: len(bench.lines("lost m1")) == 3)
    assert all("SIGABRT" in line for line in bench.lines("lost m1"))
    until(lambda: not bench.redis.exists("rq:job:m1-second"))
    bench.submit("m2", ("first", "geometry"))
    bench.wait_for("first m2")
    assert worker.poll() is None
    assert len(bench.lines("crash m1")) == 3
    assert bench.lines("second m1") == []


@pytest.mark.parametrize("kind", ["geometry", "inference"])
def test_a_step_that_is_killed_once_runs_again_and_then_the_steps_behind_it(
    bench: Bench, kind: Queue
) -> None:
    worker = bench.worker(kind)
    bench.submit("m1", ("hold", kind), ("second", kind), ("third", "geometry"))
    os.kill(int(bench.wait_for("hold m1")[2]), signal.SIGKILL)
    (bench.folder / "go").touch()
    if kind == "inference":  # the step is the worker
        worker.wait()
        bench.end_claims(kind)
        bench.worker("inference")
        bench.worker("geometry")
    bench.wait_for("third m1")
    assert bench.names() == ["hold", "lost", "hold", "held", "second", "third"]
    until(lambda: bench.redis.zcard(f"rq:wip:{kind}") == 0)


def test_a_step_that_fell_between_the_queue_and_a_worker_is_started_again(bench: Bench) -> None:
    bench.submit("m1", ("first", "geometry"), ("second", "geometry"))
    bench.redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")  # where its worker died
    seen = "rq:queue:geometry:intermediate:first_seen:m1-first"
    bench.redis.set(seen, time.time() - 61)  # as if a minute were over
    bench.worker("geometry")
    bench.wait_for("second m1")
    assert bench.names() == ["lost", "first", "second"]


def test_a_step_started_again_can_be_dismissed_while_it_waits(bench: Bench) -> None:
    worker = bench.worker("geometry")
    queue = bench.submit("m1", ("hold", "geometry"), ("second", "geometry"))
    bench.wait_for("hold m1")
    worker.kill()
    worker.wait()
    bench.end_claims("geometry")
    executions = bench.redis.keys("rq:execution:m1-hold:*")
    assert executions
    bench.redis.delete(*executions)  # they expire with the claim
    bench.submit("m2", ("hold", "geometry"))
    bench.worker("geometry")  # finds m1, and is busy with m2 before it comes to that
    bench.wait_for("hold m2")
    assert bench.redis.lrange("rq:queue:geometry", 0, -1) == [b"m1-hold"]
    queue.dismiss("m1", "map")
    assert [key for key in bench.redis.keys("rq:*") if b"m1" in key] == []


def test_a_killed_worker_takes_its_step_along_and_the_next_one_starts_it_again(bench: Bench) -> None:
    first = bench.worker("geometry")
    bench.submit("m1", ("hold", "geometry"), ("second", "geometry"))
    pid = int(bench.wait_for("hold m1")[2])
    until(lambda: bench.redis.zcard("rq:wip:geometry") == 1)
    first.kill()
    until(lambda: not running(pid))
    (end,) = bench.claims("geometry").values()
    assert end < time.time() + 70  # found in about a minute
    bench.end_claims("geometry")
    (bench.folder / "go").touch()
    bench.worker("geometry")
    bench.wait_for("second m1")
    assert bench.names() == ["hold", "lost", "hold", "held", "second"]


@pytest.mark.parametrize("kind", ["geometry", "inference"])
def test_a_step_stopped_with_its_worker_goes_on_with_the_next_and_lost_no_attempt(
    bench: Bench, kind: Queue
) -> None:
    worker = bench.worker(kind, grace=0.3)
    bench.submit("m1", ("hold", kind), ("second", kind))
    pid = int(bench.wait_for("hold m1")[2])
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(15) == 0
    assert not running(pid)
    assert bench.redis.lrange(f"rq:queue:{kind}", 0, -1) == [b"m1-hold"]
    (bench.folder / "go").touch()
    bench.worker(kind)
    bench.wait_for("second m1")
    assert bench.names() == ["hold", "stopped", "ended", "hold", "held", "second"]


def test_a_step_that_gets_the_stop_before_its_worker_does_goes_on_too(bench: Bench) -> None:
    worker = bench.worker("geometry", grace=30)
    bench.submit("m1", ("hold", "geometry"))
    pid = int(bench.wait_for("hold m1")[2])
    worker.send_signal(signal.SIGTERM)
    (key,) = bench.redis.smembers("rq:workers")
    until(lambda: bench.redis.hexists(key, "shutdown_requested_date"))
    os.kill(pid, signal.SIGTERM)  # a service manager that tells every process of the group
    assert worker.wait(15) == 0
    assert bench.names() == ["hold", "stopped", "ended"]
