"""A bench of one test's own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.embedded_redis import EmbeddedRedis
from tests.integration.bench import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with EmbeddedRedis(tmp_path / "redis") as server:
        bench = Bench(tmp_path, server.url)
        yield bench
        for worker in bench.workers:
            worker.kill()
            worker.wait()
