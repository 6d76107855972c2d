"""A step as the workers accept it, against an embedded server; no worker runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis
from rq.exceptions import NoSuchJobError
from rq.serializers import JSONSerializer

from service.queue import JobQueue
from service.up.embedded_redis import EmbeddedRedis
from worker.rq_jobs import StepJob


@pytest.fixture
def redis(tmp_path: Path) -> Iterator[Redis]:
    with EmbeddedRedis(tmp_path / "redis") as server:
        queue = JobQueue(server.url)
        queue.submit("s1", "survey")
        queue.close()
        client = Redis.from_url(server.url)
        yield client
        client.close()


def fetch(redis: Redis, name: str) -> StepJob:
    return StepJob.fetch(name, connection=redis, serializer=JSONSerializer)


def test_a_step_that_died_before_it_began_leaves_its_place_between_queue_and_worker(redis: Redis) -> None:
    redis.lmove("rq:queue:geometry", "rq:queue:geometry:intermediate")
    step = fetch(redis, "s1-register")
    assert not step.should_retry
    step.start_again()
    assert step.should_retry
    assert redis.exists("rq:queue:geometry:intermediate") == 0


def test_dropping_the_steps_behind_one_leaves_nothing_of_them(redis: Redis) -> None:
    fetch(redis, "s1-register").drop_dependents()
    for name in ("s1-score", "s1-export"):
        with pytest.raises(NoSuchJobError):
            fetch(redis, name)
    assert redis.zcard("rq:deferred:geometry") == redis.zcard("rq:deferred:inference") == 0
    assert fetch(redis, "s1-register").get_status() == "queued"
