"""The queue against an embedded server; no worker runs."""

from __future__ import annotations

import functools
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import pytest
from redis import Redis

from service.catalog.steps import STEPS
from service.errors import QueueUnavailable
from service.queue import Claim, JobQueue
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


REGISTER = STEPS["map"][0]


def begin(redis: Redis, name: str, *, worker: str = "w1", queue: str = "geometry") -> None:
    """What a worker leaves in Redis that has claimed a step."""
    redis.lrem(f"rq:queue:{queue}", 1, name)
    redis.zadd(f"rq:wip:{queue}", {f"{name}:1": 1})
    redis.hset(f"rq:execution:{name}:1", "worker_name", worker)


def waiting(redis: Redis) -> list[str]:
    return cast("list[str]", redis.lrange("rq:queue:geometry", 0, -1))


def test_a_step_carries_a_name_and_an_id_and_bounded_times(queue: JobQueue, redis: Redis) -> None:
    queue.arrange("geometry", [("m1", REGISTER)])
    raw = Redis(connection_pool=redis.connection_pool)
    job = raw.hmget("rq:job:m1-register", "timeout", "origin", "status", "description")
    assert job == ["120", "geometry", "queued", "worker.jobs.register_map('m1')"]
    assert redis.ttl("rq:job:m1-register") > 0


def test_what_waits_is_what_is_wanted_in_that_order(queue: JobQueue, redis: Redis) -> None:
    queue.arrange("geometry", [("m1", REGISTER), ("m2", REGISTER)])
    assert waiting(redis) == ["m1-register", "m2-register"]
    queue.arrange("geometry", [("m3", REGISTER), ("m1", REGISTER)])
    assert waiting(redis) == ["m3-register", "m1-register"]
    assert sorted(redis.keys("rq:job:*")) == ["rq:job:m1-register", "rq:job:m3-register"]
    assert redis.exists("rq:queue:inference") == 0


def test_what_somebody_else_wrote_is_removed(queue: JobQueue, redis: Redis) -> None:
    redis.rpush("rq:queue:geometry", "forged")
    redis.hset("rq:job:forged", "data", "os.system")
    queue.arrange("geometry", [])
    assert waiting(redis) == []
    assert not redis.exists("rq:job:forged")


def test_the_state_follows_a_step_from_the_queue_to_its_end(queue: JobQueue, redis: Redis) -> None:
    assert queue.snapshot().held == frozenset()
    queue.arrange("geometry", [("m1", REGISTER)])
    assert queue.snapshot()["geometry"].waiting == ("m1-register",)
    redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")  # a worker is about to claim it
    assert queue.snapshot()["geometry"].taken == ("m1-register",)
    redis.delete("rq:queue:geometry:intermediate")
    begin(redis, "m1-register")
    assert queue.snapshot()["geometry"].claims == (Claim(step="m1-register", execution="1", worker="w1"),)
    assert queue.snapshot().held == {"m1-register"}
    redis.delete("rq:execution:m1-register:1")  # the claim has ended by itself
    (claim,) = queue.snapshot()["geometry"].claims
    assert (claim.worker, queue.snapshot().held) == (None, frozenset())


@pytest.mark.parametrize("by", ["taken", "claimed"])
def test_a_step_that_a_worker_has_is_not_queued_again(queue: JobQueue, redis: Redis, by: str) -> None:
    queue.arrange("geometry", [("m1", REGISTER)])
    if by == "taken":
        redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")
    else:
        begin(redis, "m1-register")
    queue.arrange("geometry", [("m1", REGISTER), ("m2", REGISTER)])
    assert waiting(redis) == ["m2-register"]
    assert redis.exists("rq:job:m1-register")


def test_a_claim_that_is_released_leaves_nothing(queue: JobQueue, redis: Redis) -> None:
    queue.arrange("geometry", [("m1", REGISTER)])
    begin(redis, "m1-register")
    queue.release(queue.snapshot()["geometry"].claims)
    assert redis.keys("rq:*") == []


def test_an_old_claim_that_is_released_takes_nothing_from_the_step_that_waits_again(
    queue: JobQueue, redis: Redis
) -> None:
    queue.arrange("geometry", [("m1", REGISTER)])
    begin(redis, "m1-register")
    old = queue.snapshot()["geometry"].claims
    redis.delete("rq:execution:m1-register:1")
    queue.arrange("geometry", [("m1", REGISTER)])
    queue.release(old)
    assert waiting(redis) == ["m1-register"]
    assert redis.exists("rq:job:m1-register")
    assert queue.snapshot()["geometry"].claims == ()


def test_a_step_that_was_taken_and_dropped_can_be_queued_again(queue: JobQueue, redis: Redis) -> None:
    queue.arrange("geometry", [("m1", REGISTER)])
    redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")
    queue.drop_taken("geometry", "m1-register")
    assert redis.keys("rq:*") == []
    queue.arrange("geometry", [("m1", REGISTER)])
    assert waiting(redis) == ["m1-register"]


def test_workers_answer_while_their_key_lives(queue: JobQueue, redis: Redis) -> None:
    redis.sadd("rq:workers:geometry", "rq:worker:w1", "rq:worker:w2")
    redis.hset("rq:worker:w1", "state", "busy")
    state = queue.snapshot()["geometry"]
    assert (state.answering, state.silent) == (("w1",), ("w2",))
    queue.forget_worker("w2")
    assert queue.snapshot()["geometry"].silent == ()


def test_the_models_that_workers_keep_open_are_added_up(queue: JobQueue, redis: Redis) -> None:
    redis.sadd("rq:workers:inference", "rq:worker:w1", "rq:worker:w2", "rq:worker:w3")
    redis.hset("rq:worker:w1", mapping={"state": "busy", "models": 2, "model_bytes": 300})
    redis.hset("rq:worker:w2", mapping={"models": 1, "model_bytes": 50})
    state = queue.snapshot()["inference"]
    assert (state.models, state.model_bytes) == (3, 350)
    assert (state.answering, state.silent) == (("w1", "w2"), ("w3",))
    assert queue.snapshot()["geometry"].models == 0


def test_where_no_worker_is_alive_all_claims_are_taken_away(queue: JobQueue, redis: Redis) -> None:
    queue.arrange("geometry", [("m1", REGISTER)])
    begin(redis, "m1-register")
    redis.rpush("rq:queue:geometry:intermediate", "m2-register")
    redis.sadd("rq:workers:geometry", "rq:worker:w1")
    queue.release_claims()
    assert redis.keys("rq:*") == []


def test_dismiss_leaves_nothing_of_a_waiting_job_and_all_of_another(queue: JobQueue, redis: Redis) -> None:
    queue.arrange("geometry", [("s1", STEPS["survey"][0]), ("s2", STEPS["survey"][0])])
    queue.dismiss("s1", "survey")
    assert waiting(redis) == ["s2-register"]
    assert redis.keys("rq:job:*") == ["rq:job:s2-register"]


def test_dismissing_an_unknown_job_does_nothing(queue: JobQueue, redis: Redis) -> None:
    queue.dismiss("nothing", "map")
    assert redis.keys("rq:job:*") == []


def test_a_refused_connection_is_reported_and_the_password_is_not(tmp_path: Path) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        queue = JobQueue(f"redis://:secret@127.0.0.1:{closed.getsockname()[1]}")
        calls: list[Callable[[], object]] = [
            queue.ping,
            queue.snapshot,
            queue.release_claims,
            functools.partial(queue.arrange, "geometry", [("m1", REGISTER)]),
            functools.partial(queue.drop_taken, "geometry", "m1-register"),
            functools.partial(queue.dismiss, "m1", "map"),
        ]
        for call in calls:
            with pytest.raises(QueueUnavailable, match="nothing was recorded") as found:
                call()
            assert "secret" not in str(found.value)


@pytest.mark.timeout(15)
def test_a_server_that_accepts_and_says_nothing_does_not_hold_the_request() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(QueueUnavailable):
        JobQueue(f"redis://127.0.0.1:{silent.getsockname()[1]}").ping()
