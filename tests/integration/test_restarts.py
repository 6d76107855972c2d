"""Steps that end without a word, with real processes: what is started again, at what cost, and what is left behind."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import update

from service.catalog.sql import tables
from service.catalog.steps import Queue
from service.dispatch import Dispatcher
from service.errors import DatabaseUnavailable
from service.up.children import WorkerPool
from service.up.embedded_redis import EmbeddedRedis
from service.up.launcher import Supervision
from tests.support.bench import STANDIN, Bench
from tests.support.processes import running, until
from worker.endings import ending_of, ending_of_status

KINDS: tuple[Queue, ...] = ("geometry", "inference")


def ended(bench: Bench, job_id: str, status: str = "successful") -> None:
    """Wait for the end of a job; it is as it should be, and nothing of it is left in Redis or on the disk."""
    until(lambda: bench.job(job_id).status not in ("accepted", "running"), 60)
    assert bench.job(job_id).status == status, bench.job(job_id).problem
    until(lambda: bench.traces(job_id) == [])
    scratch = bench.settings.scratch_dir()
    until(lambda: not scratch.exists() or list(scratch.iterdir()) == [])


def go(bench: Bench) -> None:
    (bench.folder / "go").touch()


def test_a_step_that_crashes_every_time_is_given_up_after_three_and_the_worker_goes_on(bench: Bench) -> None:
    worker = bench.worker("geometry")
    bench.submit("m1", ("crash", "geometry"), ("second", "geometry"))
    ended(bench, "m1", "failed")
    problem = bench.job("m1").problem
    assert problem is not None
    assert problem.code == "worker_died"
    assert "SIGABRT" in problem.detail
    assert "3 attempts" in problem.detail
    bench.submit("m2", ("finish", "geometry"))
    ended(bench, "m2")
    assert worker.poll() is None
    assert bench.names() == ["crash", "lost"] * 3 + ["finish"]


def test_attempts_are_counted_for_each_step_and_not_for_the_job(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("crash_once", "geometry"), ("hold", "geometry"), ("finish", "geometry"))
    bench.wait_for("hold m1")
    assert bench.lines("lost m1")
    assert bench.job("m1").attempts == 0
    go(bench)
    ended(bench, "m1")


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_that_is_killed_from_outside_runs_again_and_lost_no_attempt(bench: Bench, kind: Queue) -> None:
    worker = bench.worker(kind)
    bench.submit("m1", ("hold", kind), ("second", kind), ("finish", "geometry"))
    os.kill(int(bench.wait_for("hold m1")[2]), signal.SIGKILL)
    if kind == "inference":  # the step is the worker
        worker.wait()
        bench.end_claims(kind)
        bench.worker("inference")
        bench.worker("geometry")
    until(lambda: len(bench.lines("hold m1")) == 2)
    job = bench.job("m1")
    assert (job.attempts, job.interruptions) == (0, 1)
    assert job.message.startswith("interrupted, ")
    go(bench)
    ended(bench, "m1")
    names = [name for name in bench.names() if name != "interrupted"]
    assert names == ["hold", "hold", "held", "second", "finish"]


def test_a_step_killed_again_and_again_from_outside_is_given_up_at_last(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("hold", "geometry"), ("finish", "geometry"))
    bench.wait_for("hold m1")
    with bench.catalog.database.write() as session:
        session.execute(update(tables.Job).values(interruptions=19))
    os.kill(int(bench.wait_for("hold m1")[2]), signal.SIGKILL)
    ended(bench, "m1", "failed")
    problem = bench.job("m1").problem
    assert problem is not None
    assert "20 interruptions" in problem.detail


def test_a_worker_that_died_between_taking_a_step_and_claiming_it_loses_nothing(bench: Bench) -> None:
    bench.submit("m1", ("first", "geometry"), ("finish", "geometry"))
    until(lambda: bench.redis.llen("rq:queue:geometry"))
    bench.redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")  # where its worker died
    assert bench.redis.llen("rq:queue:geometry") == 0
    bench.worker("geometry")
    ended(bench, "m1")
    assert bench.names() == ["first", "finish"]


def test_a_worker_that_died_between_claiming_a_step_and_beginning_it_loses_nothing(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("early", "geometry"), ("finish", "geometry"))
    ended(bench, "m1")
    assert bench.names() == ["interrupted", "early", "finish"]


def test_a_worker_that_dies_right_after_a_first_step_of_its_own_loses_nothing(bench: Bench) -> None:
    """As it was in release 0.1: what a worker held before its first step told it from one that had worked."""
    worker = bench.worker("geometry")
    bench.submit("m1", ("first", "geometry"), ("hold", "geometry"), ("finish", "geometry"))
    bench.wait_for("hold m1")
    worker.kill()
    worker.wait()
    bench.end_claims("geometry")
    go(bench)
    bench.worker("geometry")
    ended(bench, "m1")
    assert bench.job("m1").attempts == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_worker_that_its_supervisor_saw_die_is_not_waited_for(bench: Bench, kind: Queue) -> None:
    worker = bench.worker(kind, name="w1")
    bench.submit("m1", ("hold", kind), ("finish", "geometry"))
    pid = int(bench.wait_for("hold m1")[2])
    worker.kill()
    worker.wait()
    until(lambda: not running(pid))
    bench.dispatcher.worker_ended("w1", "the worker ended by signal SIGKILL", by_itself=False)
    assert bench.claims(kind) == []
    assert bench.redis.smembers("rq:workers") == set()
    assert bench.redis.lrange(f"rq:queue:{kind}", 0, -1) == [b"m1-hold"]
    job = bench.job("m1")
    assert (job.attempts, job.interruptions) == (0, 1)


def test_a_worker_that_crashed_by_itself_costs_its_step_an_attempt(bench: Bench) -> None:
    worker = bench.worker("inference", name="w1")
    bench.submit("m1", ("hold", "inference"), ("finish", "geometry"))
    bench.wait_for("hold m1")
    worker.kill()
    worker.wait()
    bench.dispatcher.worker_ended("w1", "the worker ended by signal SIGSEGV", by_itself=True)
    assert bench.job("m1").attempts == 1


def test_a_claim_of_a_dead_worker_ends_within_seconds(bench: Bench) -> None:
    worker = bench.worker("geometry")
    bench.submit("m1", ("hold", "geometry"))
    bench.wait_for("hold m1")
    worker.kill()
    (claim,) = bench.claims("geometry")
    assert 0 < bench.redis.ttl(f"rq:execution:{claim}") <= 15


def test_a_step_that_is_frozen_is_ended_and_runs_again(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("hold", "geometry"), ("finish", "geometry"))
    frozen = int(bench.wait_for("hold m1")[2])
    os.kill(frozen, signal.SIGSTOP)
    until(lambda: not running(frozen))
    until(lambda: len(bench.lines("hold m1")) == 2)
    job = bench.job("m1")
    assert (job.attempts, job.interruptions) == (0, 1)
    assert "stopped from outside" in job.message
    go(bench)
    ended(bench, "m1")


@pytest.mark.parametrize("kind", KINDS)
def test_a_frozen_worker_is_ended_by_its_supervisor_and_its_step_runs_again(
    bench: Bench, kind: Queue
) -> None:

    environment = {
        **os.environ,
        "SPICD_REDIS_URL": bench.redis_url,
        "SPICD_DATA_DIR": str(bench.settings.data_dir),
    }
    program = (
        "/bin/sh",
        "-c",
        f'exec "$PYTHON" -m {STANDIN} "$1" "$SPICD_REDIS_URL" "{bench.folder}" 5 "$7"',
        "worker",
    )

    environment["PYTHON"] = sys.executable
    pool = WorkerPool(
        geometry=kind == "geometry",
        inference=kind == "inference",
        environment=environment,
        program=program,
        watcher=Supervision(bench.settings),
    )
    with pool:
        bench.submit("m1", ("hold", kind), ("finish", kind))
        bench.wait_for("hold m1")
        (worker,) = pool.workers
        frozen = worker.pid
        os.kill(frozen, signal.SIGSTOP)

        def again() -> bool:
            pool.check()
            return len(bench.lines("hold m1")) == 2

        until(again)
        assert not running(frozen)
        go(bench)
        ended(bench, "m1")
    assert bench.job("m1").attempts == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_that_does_not_hear_that_its_time_is_up_is_ended_all_the_same(
    bench: Bench, kind: Queue
) -> None:
    worker = bench.worker(kind)
    bench.submit("m1", ("deaf", kind), timeout_s=1)
    until(lambda: bench.job("m1").status == "failed")
    problem = bench.job("m1").problem
    assert problem is not None
    assert problem.code == "timed_out"
    if kind == "inference":  # the step is the worker
        assert worker.wait(15) == 1
    else:
        pid = int(bench.wait_for("deaf m1")[2])
        until(lambda: not running(pid))


def test_a_step_that_a_frozen_worker_takes_up_again_gives_way_to_the_run_that_took_its_place(
    bench: Bench,
) -> None:
    begun = bench.jobs
    bench.submit("m1", ("hold", "geometry"), ("finish", "geometry"))
    first = begun.begin("m1", "hold")
    assert first is not None
    assert begun.interrupt("m1", "hold", "the worker that had it went away", begun=first.begun)
    second = begun.begin("m1", "hold")
    assert second is not None
    assert not begun.report(first, message="late", progress=0.9)
    assert not begun.advance(first)
    assert begun.report(second, message="in time", progress=0.1)
    assert begun.advance(second)


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_stopped_with_its_worker_goes_on_with_the_next_and_lost_no_attempt(
    bench: Bench, kind: Queue
) -> None:
    worker = bench.worker(kind, grace=0.3)
    bench.submit("m1", ("hold", kind), ("finish", kind))
    pid = int(bench.wait_for("hold m1")[2])
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(15) == 0
    assert not running(pid)
    job = bench.job("m1")
    assert (job.status, job.attempts, job.interruptions) == ("running", 0, 0)
    go(bench)
    bench.worker(kind)
    ended(bench, "m1")
    assert bench.names() == ["hold", "stopped", "ended", "hold", "held", "finish"]


def test_a_step_that_gets_the_stop_before_its_worker_does_goes_on_too(bench: Bench) -> None:
    worker = bench.worker("geometry", grace=30)
    bench.submit("m1", ("hold", "geometry"), ("finish", "geometry"))
    pid = int(bench.wait_for("hold m1")[2])
    worker.send_signal(signal.SIGTERM)
    time.sleep(0.5)  # the worker has noted it, and gives the step its grace
    os.kill(pid, signal.SIGTERM)  # a service manager that tells every process of the group
    assert worker.wait(15) == 0
    assert bench.names() == ["hold", "stopped", "ended"]


def test_what_a_killed_step_wrote_aside_is_swept_and_what_a_living_one_writes_is_not(bench: Bench) -> None:
    bench.worker("geometry")
    bench.worker("geometry")
    bench.submit("m1", ("hold", "geometry"), ("finish", "geometry"))
    bench.submit("m2", ("hold", "geometry"), ("finish", "geometry"))
    bench.wait_for("hold m1")
    pid = int(bench.wait_for("hold m2")[2])
    scratch = bench.settings.scratch_dir()
    (living,) = scratch.glob("m1-hold.*")
    (dead,) = scratch.glob("m2-hold.*")
    os.kill(pid, signal.SIGKILL)
    until(lambda: not dead.exists())
    assert (living / "half").exists()
    go(bench)
    ended(bench, "m1")
    ended(bench, "m2")


def test_a_process_that_a_step_leaves_behind_ends_with_it(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("stray", "geometry"), ("finish", "geometry"))
    pid = int(bench.wait_for("stray m1")[2])
    ended(bench, "m1")
    until(lambda: not running(pid))


def test_workers_outlive_redis_and_go_on_with_what_it_lost(tmp_path: Path) -> None:
    server = EmbeddedRedis(tmp_path / "redis")
    server.start()
    with Bench(tmp_path, server.url) as bench:
        workers = [bench.worker(kind) for kind in KINDS]
        bench.submit("m1", ("hold", "geometry"), ("second", "inference"), ("finish", "geometry"))
        bench.wait_for("hold m1")
        server.stop()
        shutil.rmtree(tmp_path / "redis")
        go(bench)
        bench.wait_for("held m1")
        time.sleep(3)  # the step has ended, and nobody can be told
        assert [worker.poll() for worker in workers] == [None, None]
        server.start()
        ended(bench, "m1")
        assert [worker.poll() for worker in workers] == [None, None]
    server.stop()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("what", ["idle", "in a step"])
def test_a_worker_that_is_told_to_stop_while_redis_is_away_stops(
    tmp_path: Path, kind: Queue, what: str
) -> None:
    server = EmbeddedRedis(tmp_path / "redis")
    server.start()
    with Bench(tmp_path, server.url) as bench:
        worker = bench.worker(kind, grace=0.5)
        until(lambda: bench.redis.scard(f"rq:workers:{kind}"))
        if what == "in a step":
            bench.submit("m1", ("hold", kind), ("finish", kind))
            bench.wait_for("hold m1")
        server.stop()
        worker.send_signal(signal.SIGTERM)
        worker.wait(30)
        if what == "in a step":
            job = bench.job("m1")
            assert (job.status, job.attempts) == ("running", 0)


@pytest.mark.parametrize("redis", ["kept its data", "lost its data"])
def test_a_job_that_ran_when_everything_was_killed_goes_on_at_the_next_start(
    tmp_path: Path, redis: str
) -> None:
    server = EmbeddedRedis(tmp_path / "redis")
    server.start()
    with Bench(tmp_path, server.url) as bench:
        worker = bench.worker("geometry")
        bench.submit("m1", ("hold", "geometry"), ("finish", "geometry"))
        bench.wait_for("hold m1")
        worker.kill()
        worker.wait()
        os.kill(server.pid, signal.SIGKILL)
    server.stop()
    if redis == "lost its data":
        shutil.rmtree(tmp_path / "redis")
    server.start()
    with Bench(tmp_path, server.url) as bench:
        bench.submit("m0", ("hold", "geometry"), ("finish", "geometry"))  # the steps are known again
        bench.queue.release_claims()
        until(lambda: bench.job("m1").interruptions == 1)
        go(bench)
        bench.worker("geometry")
        ended(bench, "m1")
        assert bench.job("m1").attempts == 0
    server.stop()


def test_any_number_of_dispatchers_hand_a_step_over_once(bench: Bench) -> None:
    others = [Dispatcher(bench.jobs, bench.queue) for _ in range(4)]
    bench.worker("geometry")
    for number in range(5):
        bench.submit(f"m{number}", ("first", "geometry"), ("finish", "geometry"))
        for other in others:
            other.run()
    for number in range(5):
        ended(bench, f"m{number}")
    assert sorted(bench.names()) == ["finish"] * 5 + ["first"] * 5


def test_a_dismissed_job_is_not_started_again_where_the_queue_was_not_told(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("hold", "geometry"), ("finish", "geometry"))
    pid = int(bench.wait_for("hold m1")[2])
    bench.jobs.dismiss("m1")
    os.kill(pid, signal.SIGKILL)
    ended(bench, "m1", "dismissed")
    assert [name for name in bench.names() if name != "interrupted"] == ["hold"]


def test_a_full_disk_fails_the_step_and_says_so(bench: Bench) -> None:
    bench.worker("geometry")
    bench.submit("m1", ("full", "geometry"))
    ended(bench, "m1", "failed")
    problem = bench.job("m1").problem
    assert problem is not None
    assert problem.code == "disk_full"


def test_a_step_that_cannot_say_that_the_database_left_it_is_interrupted_and_not_failed() -> None:
    step = SimpleNamespace(id="m1-register", timeout=60)
    ending = ending_of(DatabaseUnavailable("the database does not answer"), step)  # type: ignore[arg-type]
    assert ending.how == "interrupted"


@pytest.mark.parametrize(
    ("status", "out_of_memory", "how"),
    [
        (signal.SIGKILL, False, "interrupted"),
        (signal.SIGTERM, False, "interrupted"),
        (signal.SIGKILL, True, "lost"),
        (signal.SIGSEGV, False, "lost"),
        (signal.SIGABRT | 0x80, False, "lost"),
        (3 << 8, False, "lost"),
    ],
    ids=["killed", "terminated", "out of memory", "fault", "abort with core", "exit status 3"],
)
def test_what_comes_from_outside_is_told_from_what_a_step_did_itself(
    status: int, out_of_memory: bool, how: str
) -> None:
    step = SimpleNamespace(id="m1-register", timeout=60)
    assert ending_of_status(status, step, out_of_memory=out_of_memory).how == how  # type: ignore[arg-type]
