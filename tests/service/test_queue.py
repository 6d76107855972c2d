"""The queue against an embedded server; no worker runs."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from service.embedded_redis import EmbeddedRedis
from service.errors import QueueUnavailable
from service.queue import JobQueue


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
        for call in (queue.ping, lambda: queue.submit("m1", "map"), lambda: queue.dismiss("m1", "map")):
            with pytest.raises(QueueUnavailable, match="nothing was recorded") as found:
                call()
            assert "secret" not in str(found.value)


@pytest.mark.timeout(15)
def test_a_server_that_accepts_and_says_nothing_does_not_hold_the_request() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(QueueUnavailable):
        JobQueue(f"redis://127.0.0.1:{silent.getsockname()[1]}").ping()
