"""The queue against an embedded server; no worker runs."""

from __future__ import annotations

import functools
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from service.catalog.steps import ALLOWED_FUNCTIONS, STEPS, JobKind, Step
from service.errors import QueueUnavailable
from service.queue import JobQueue
from service.up.embedded_redis import EmbeddedRedis


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    with EmbeddedRedis(tmp_path_factory.mktemp("queue") / "redis") as server:
        yield server


@pytest.fixture
def redis(server: EmbeddedRedis) -> Iterator[Redis]:
    client = Redis.from_url(server.url, decode_responses=True)
    client.flushdb()
    yield client
    client.close()


@pytest.fixture
def queue(server: EmbeddedRedis, redis: Redis) -> Iterator[JobQueue]:
    queue = JobQueue(server.url, timeout_s=120)
    yield queue
    queue.close()


def test_submit_queues_the_first_step_and_parks_the_others(queue: JobQueue, redis: Redis) -> None:
    queue.submit("s1", "survey")
    assert redis.lrange("rq:queue:geometry", 0, -1) == ["s1-register"]
    assert redis.exists("rq:queue:inference") == 0
    assert redis.smembers("rq:job:s1-register:dependents") == {"s1-score"}
    assert redis.smembers("rq:job:s1-score:dependents") == {"s1-export"}
    assert redis.zrange("rq:deferred:inference", 0, -1) == ["s1-score"]


def test_a_step_carries_a_name_and_an_id_and_bounded_times(queue: JobQueue, redis: Redis) -> None:
    queue.submit("m1", "map")
    raw = Redis(connection_pool=redis.connection_pool)
    job = raw.hmget("rq:job:m1-register", "timeout", "result_ttl", "failure_ttl", "origin", "description")
    assert job == ["120", "86400", "86400", "geometry", "worker.jobs.register_map('m1')"]


def test_submitting_twice_queues_once(queue: JobQueue, redis: Redis) -> None:
    queue.submit("m1", "map")
    queue.submit("m1", "map")
    assert redis.lrange("rq:queue:geometry", 0, -1) == ["m1-register"]
    assert redis.zcard("rq:deferred:inference") == 1


def begin(redis: Redis, name: str, queue: str = "geometry") -> None:
    """What a worker leaves in Redis that has taken a step."""
    redis.lrem(f"rq:queue:{queue}", 1, name)
    redis.zadd(f"rq:wip:{queue}", {f"{name}:1": time.time() + 60})
    redis.hset(f"rq:job:{name}", "status", "started")


def test_a_job_is_held_while_a_step_waits_or_a_worker_has_it(queue: JobQueue, redis: Redis) -> None:
    assert not queue.holds("m1", "map")
    queue.submit("m1", "map")
    assert queue.holds("m1", "map")
    redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")  # a worker is about to begin
    assert queue.holds("m1", "map")
    redis.delete("rq:queue:geometry:intermediate")
    begin(redis, "m1-register")
    assert queue.holds("m1", "map")
    redis.delete("rq:wip:geometry")
    assert not queue.holds("m1", "map")
    assert not queue.holds("m", "map")


def test_a_step_that_a_worker_has_is_not_queued_again(queue: JobQueue, redis: Redis) -> None:
    queue.submit("m1", "map")
    begin(redis, "m1-register")
    queue.submit("m1", "map")
    assert redis.exists("rq:queue:geometry") == 0
    assert redis.hget("rq:job:m1-register", "status") == "started"


def test_a_step_whose_claims_are_released_is_queued_again_with_those_behind_it(
    queue: JobQueue, redis: Redis
) -> None:
    queue.submit("s1", "survey")
    begin(redis, "s1-register")
    redis.set("rq:clean_registries:geometry", 1)  # of a worker that was killed while it cleaned up
    queue.release_claims()
    assert redis.exists("rq:clean_registries:geometry") == 0
    queue.submit("s1", "survey")
    assert redis.lrange("rq:queue:geometry", 0, -1) == ["s1-register"]
    assert redis.hget("rq:job:s1-register", "status") == "queued"
    assert redis.smembers("rq:job:s1-score:dependents") == {"s1-export"}
    assert redis.zrange("rq:deferred:inference", 0, -1) == ["s1-score"]


def test_a_step_that_a_worker_took_and_never_began_is_queued_again_once_the_claims_are_released(
    queue: JobQueue, redis: Redis
) -> None:
    queue.submit("m1", "map")
    redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")
    queue.submit("m1", "map")
    assert redis.exists("rq:queue:geometry") == 0
    queue.release_claims()
    queue.submit("m1", "map")
    assert redis.lrange("rq:queue:geometry", 0, -1) == ["m1-register"]


def test_a_job_goes_on_with_the_step_that_had_not_finished(queue: JobQueue, redis: Redis) -> None:
    queue.submit("s1", "survey")
    begin(redis, "s1-register")
    redis.hset("rq:job:s1-register", "status", "finished")
    redis.zrem("rq:deferred:inference", "s1-score")
    begin(redis, "s1-score", "inference")
    queue.release_claims()
    queue.submit("s1", "survey")
    assert redis.exists("rq:queue:geometry") == 0
    assert redis.lrange("rq:queue:inference", 0, -1) == ["s1-score"]
    assert redis.zrange("rq:deferred:geometry", 0, -1) == ["s1-export"]


def test_a_step_that_failed_unheard_leaves_no_trace_when_it_is_queued_again(
    queue: JobQueue, redis: Redis
) -> None:
    queue.submit("m1", "map")
    redis.delete("rq:queue:geometry")
    redis.hset("rq:job:m1-register", mapping={"status": "failed", "exc_info": "x", "retries_left": 5})
    redis.zadd("rq:failed:geometry", {"m1-register": time.time() + 60})
    queue.submit("m1", "map")
    assert redis.zcard("rq:failed:geometry") == 0
    assert redis.hget("rq:job:m1-register", "retries_left") is None
    assert redis.lrange("rq:queue:geometry", 0, -1) == ["m1-register"]


def test_dismiss_leaves_nothing_of_a_waiting_job_and_all_of_another(queue: JobQueue, redis: Redis) -> None:
    queue.submit("s1", "survey")
    queue.submit("s2", "survey")
    queue.dismiss("s1", "survey")
    assert redis.lrange("rq:queue:geometry", 0, -1) == ["s2-register"]
    assert not [key for key in redis.keys("rq:job:*") if "s1" in key]
    assert redis.zrange("rq:deferred:geometry", 0, -1) == ["s2-export"]


def test_dismissing_an_unknown_job_does_nothing(queue: JobQueue, redis: Redis) -> None:
    queue.dismiss("nothing", "map")
    assert redis.keys("rq:job:*") == []


def test_a_refused_connection_is_reported_and_the_password_is_not(tmp_path: Path) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        queue = JobQueue(f"redis://:secret@127.0.0.1:{closed.getsockname()[1]}")
        about = (queue.submit, queue.holds, queue.dismiss)
        calls = [functools.partial(call, "m1", "map") for call in about]
        for call in (queue.ping, queue.release_claims, *calls):
            with pytest.raises(QueueUnavailable, match="nothing was recorded") as found:
                call()
            assert "secret" not in str(found.value)


@pytest.mark.timeout(15)
def test_a_server_that_accepts_and_says_nothing_does_not_hold_the_request() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(QueueUnavailable):
        JobQueue(f"redis://127.0.0.1:{silent.getsockname()[1]}").ping()


#: The steps of a map as earlier builds queued them.
FORMER: dict[JobKind, tuple[Step, ...]] = {
    "map": (
        STEPS["map"][0],
        Step(name="describe", function="worker.jobs.describe_map", queue="inference"),
    )
}


def test_a_map_that_an_earlier_build_queued_goes_on_with_the_step_that_it_queued(
    server: EmbeddedRedis, queue: JobQueue
) -> None:
    former = JobQueue(server.url, steps=FORMER)
    former.submit("m1", "map")
    former.close()
    assert queue.holds("m1", "map")  # so it is not submitted again when the service starts
    assert {step.function for step in FORMER["map"]} <= ALLOWED_FUNCTIONS


def test_a_map_whose_last_step_an_earlier_build_queued_gets_the_step_of_today_beside_it(
    server: EmbeddedRedis, queue: JobQueue, redis: Redis
) -> None:
    former = JobQueue(server.url, steps=FORMER)
    former.submit("m1", "map")
    former.close()
    redis.delete("rq:queue:geometry")
    redis.hset("rq:job:m1-register", "status", "finished")
    redis.rpush("rq:queue:inference", "m1-describe")
    queue.submit("m1", "map")
    assert redis.lrange("rq:queue:geometry", 0, -1) == []
    assert redis.lrange("rq:queue:inference", 0, -1) == ["m1-describe", "m1-encode"]
