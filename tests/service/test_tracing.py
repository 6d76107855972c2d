"""Traces reach a collector: of requests, and of steps in processes that were forked for them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient

from service import tracing
from service.catalog.catalog import Catalog
from tests.support.collector import Collector, attributes, collecting
from tests.support.samples import add_map, ply

#: A worker that forks for a step, which ends as rq's does: without the interpreter's own end.
FORKING = """
import os
from service import tracing
if (child := os.fork()) == 0:
    try:
        with tracing.step("job-1", "register_survey"):
            for stage in ("registering", "registering", "refining"):
                tracing.stage(stage)
            if os.environ.get("FAIL"):
                raise RuntimeError("broken")
    finally:
        os._exit(0)
os.waitpid(child, 0)
"""


@pytest.fixture
def collector() -> Iterator[Collector]:
    with collecting() as collected:
        yield collected


@pytest.fixture
def traced(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    """This process has its spans collected."""
    for name, value in collector.environment.items():
        monkeypatch.setenv(name, value)
    tracing._provider.cache_clear()
    yield collector
    if (provider := tracing._provider(os.getpid())) is not None:
        provider.shutdown()
    tracing._provider.cache_clear()


def sent(traced: Collector) -> Collector:
    """All spans that have ended."""
    provider = tracing._provider(os.getpid())
    assert provider is not None
    provider.force_flush()
    return traced


def test_a_request_is_a_span_under_its_route_and_goes_on_with_the_clients_trace(
    traced: Collector, client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    given = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    client.get("/maps/lobby", headers={"traceparent": given, "X-Request-ID": "abc"})
    span = sent(traced).named("GET /maps/{map_id}")
    assert (span.trace_id.hex(), span.parent_span_id.hex()) == tuple(given.split("-")[1:3])
    assert attributes(span) == {
        "http.request.method": "GET",
        "http.route": "/maps/{map_id}",
        "http.response.status_code": 200,
        "spicd.request_id": "abc",
    }


def test_a_request_that_submits_a_job_has_a_link_to_the_jobs_trace(
    traced: Collector, client: TestClient, catalog: Catalog
) -> None:
    add_map(catalog)
    answer = client.post("/maps/lobby/surveys", files={"scans": ("a.ply", ply())})
    job_id = answer.json()["job_id"]
    span = sent(traced).named("POST /maps/{map_id}/surveys")
    assert attributes(span)["spicd.job_id"] == job_id
    (link,) = span.links
    assert link.trace_id == tracing._of_job(job_id).trace_id.to_bytes(16)


@pytest.mark.slow
@pytest.mark.parametrize("fails", ["", "1"])
def test_a_step_in_a_forked_process_has_its_stages_and_is_in_the_jobs_trace(
    collector: Collector, fails: str
) -> None:
    environment = {**os.environ, **collector.environment, "FAIL": fails}
    subprocess.run([sys.executable, "-c", FORKING], env=environment, check=True, timeout=60)
    step = collector.named("step register_survey")
    assert step.trace_id == tracing._of_job("job-1").trace_id.to_bytes(16)
    assert attributes(step) == {"spicd.job_id": "job-1", "spicd.step": "register_survey"}
    assert (step.status.code == 2) == bool(fails)
    for name in ("registering", "refining"):
        stage = collector.named(f"stage {name}")
        assert stage.parent_span_id == step.span_id
        assert step.start_time_unix_nano <= stage.start_time_unix_nano
        assert stage.end_time_unix_nano <= step.end_time_unix_nano


@pytest.mark.slow
def test_a_collector_that_is_away_costs_a_step_little() -> None:
    environment = {**os.environ, "OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9"}
    begun = time.monotonic()
    script = FORKING.replace("os.waitpid", "import time; begun = time.monotonic(); os.waitpid")
    script += "print(time.monotonic() - begun)\n"
    ran = subprocess.run(
        [sys.executable, "-c", script], env=environment, check=True, timeout=60, capture_output=True
    )
    assert float(ran.stdout) < 10
    assert time.monotonic() - begun < 20


@pytest.mark.slow
def test_nothing_of_it_is_imported_where_no_collector_is_named() -> None:
    script = FORKING + "import sys; print([name for name in sys.modules if 'opentelemetry' in name])"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OTEL_")}
    ran = subprocess.run(
        [sys.executable, "-c", script], env=environment, check=True, timeout=60, capture_output=True
    )
    assert ran.stdout.strip() == b"[]"
