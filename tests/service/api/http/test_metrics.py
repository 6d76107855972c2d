"""/metrics: what waits, what was counted, and what is left when a part is away."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import text, update

from service.api.http.answering.problems import PROBLEMS
from service.catalog import tallies
from service.catalog.catalog import Catalog
from service.catalog.sql import tables
from service.queue import QueueState, Snapshot, step_id
from tests.support.samples import RememberingQueue, add_map, add_survey, services_of


def scraped(client: TestClient) -> dict[tuple[str, ...], float]:
    """Each sample's value, by its name and the values of its labels, these in the order of their names."""
    answer = client.get("/metrics")
    assert answer.status_code == 200
    return {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def set_job(catalog: Catalog, job_id: str, **values: object) -> None:
    with catalog.database.write() as session:
        session.execute(update(tables.Job).where(tables.Job.job_id == job_id).values(**values))


def test_the_queue_has_a_depth_and_a_wait_since_the_step_was_due(
    client: TestClient, catalog: Catalog, queue: RememberingQueue
) -> None:
    add_map(catalog)
    now = tables.now()
    _, waits = add_survey(catalog, ready=False)
    set_job(catalog, waits, step="register", due=now - timedelta(seconds=90), begun=None)
    _, runs = add_survey(catalog, ready=False, captured_at=now)
    since = now - timedelta(seconds=30)
    queue.state = replace(
        queue.state, taken=(step_id(runs, "score"),)
    )  # else the service finds its worker gone
    set_job(catalog, runs, step="score", status="running", due=now - timedelta(seconds=200), begun=since)
    found = scraped(client)
    assert found["spicd_queue_depth", "survey", "geometry"] == 1
    assert found["spicd_queue_oldest_wait_seconds", "survey", "geometry"] == pytest.approx(90, abs=5)
    assert found["spicd_queue_depth", "survey", "inference"] == 0
    assert found["spicd_steps_running", "survey", "inference"] == 1
    assert found["spicd_steps_running_oldest_seconds", "survey", "inference"] == pytest.approx(30, abs=5)
    assert found["spicd_queue_depth", "map", "geometry"] == 0
    assert found["spicd_queue_oldest_wait_seconds", "map", "geometry"] == 0


def test_tallies_are_counters_and_sums(client: TestClient, catalog: Catalog) -> None:
    add_map(catalog)
    with catalog.database.write() as session:
        tallies.tally_step(session, kind="map", step="encode", outcome="lost", waited_s=1.5, ran_s=4.0)
    found = scraped(client)
    assert found["spicd_jobs_ended_total", "map", "successful"] == 1
    assert found["spicd_scans_registered_total", "map", "accepted"] == 1
    assert found["spicd_registration_fitness_sum", "map"] == pytest.approx(0.98)
    assert found["spicd_step_seconds_count", "map", "lost", "encode"] == 1
    assert found["spicd_step_seconds_sum", "map", "lost", "encode"] == 4.0
    assert found["spicd_step_wait_seconds_sum", "map", "lost", "encode"] == 1.5


def test_a_request_that_waits_for_events_is_counted_and_is_not_slow(client: TestClient) -> None:
    assert client.get("/events").status_code == 200
    found = scraped(client)
    assert found["spicd_requests_total", "GET", "/events", "200"] == 1
    assert ("spicd_request_seconds_count", "GET", "/events") not in found


def test_webhooks_and_listeners_are_told(client: TestClient, catalog: Catalog) -> None:
    with catalog.database.write() as session:  # nobody delivers to a webhook that is claimed
        tallies.tally_delivery(session, None, delivered=False)
    webhook, _ = catalog.webhooks.add("https://example.org/hook")
    with catalog.database.write() as session:
        row = session.get_one(tables.Webhook, webhook.webhook_id)
        row.claim, row.claimed_until = "claim-of-the-test", tables.now() + timedelta(hours=1)
    add_map(catalog)
    found = scraped(client)
    assert (found["spicd_webhooks", "active"], found["spicd_webhooks", "disabled"]) == (1, 0)
    assert found[("spicd_webhook_events_waiting",)] == catalog.events.last() > 0
    assert found["spicd_webhook_attempts_total", "unanswered"] == 1
    assert found["spicd_webhook_attempts_total", "delivered"] == 0
    services_of(client).listeners.count = 3
    assert scraped(client)[("spicd_event_listeners",)] == 3
    services_of(client).listeners.count = 0


def test_every_measure_is_told_of_before_anything_is_counted(client: TestClient) -> None:
    told = client.get("/metrics").text
    for measure in tallies.MEASURES:
        assert f"# HELP {measure.name}" in told


def test_what_somebody_is_called_for_is_0_before_it_happens(client: TestClient) -> None:
    """Prometheus' `increase` does not see the first of a series that was not there."""
    found = scraped(client)
    for code in tallies.FAULTS:
        assert found["spicd_jobs_ended_total", "survey", code] == 0
        assert PROBLEMS[code]
    assert found["spicd_step_attempts_lost_total", "survey", "score"] == 0


def test_the_disk_and_the_workers_are_told(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    held = Snapshot(queues={"geometry": QueueState(answering=("a",), silent=("b", "c"))})
    monkeypatch.setattr(RememberingQueue, "snapshot", lambda _: held)
    found = scraped(client)
    assert 0 < found["spicd_disk_bytes", "free"] < found["spicd_disk_bytes", "total"]
    assert found["spicd_workers", "geometry", "answering"] == 1
    assert found["spicd_workers", "geometry", "silent"] == 2
    assert all(found["spicd_part_up", part] == 1 for part in ("database", "disk", "queue"))


def test_what_inference_workers_keep_open_and_what_their_networks_did_is_told(
    client: TestClient, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = Snapshot(queues={"inference": QueueState(answering=("a", "b"), models=3, model_bytes=5_000_000)})
    monkeypatch.setattr(RememberingQueue, "snapshot", lambda _: held)
    with catalog.database.write() as session:
        counted = {
            ("network_seconds", "m/1"): (3, 0.5),
            ("batch_size", "m/1"): (3, 130.0),
            ("batch_requests", "m/1"): (3, 7.0),
            ("wait_seconds", "m/1"): (3, 0.02),
            ("out_of_memory", "m/1"): (2, 2.0),
            ("models_opened", "m/1"): (1, 1.0),
            ("models_evicted", "m/2"): (1, 1.0),
        }
        tallies.tally_inference(session, counted)
    found = scraped(client)
    assert found[("spicd_inference_models_warm",)] == 3
    assert found[("spicd_inference_models_warm_bytes",)] == 5_000_000
    assert found["spicd_inference_batch_size_sum", "m/1"] == 130
    assert found["spicd_inference_batch_size_count", "m/1"] == 3
    assert found["spicd_inference_batch_steps_sum", "m/1"] == 7
    assert found["spicd_inference_network_seconds_sum", "m/1"] == 0.5
    assert found["spicd_inference_wait_seconds_sum", "m/1"] == pytest.approx(0.02)
    assert found["spicd_inference_out_of_memory_total", "m/1"] == 2
    assert found["spicd_inference_models_opened_total", "m/1"] == 1
    assert found["spicd_inference_models_evicted_total", "m/2"] == 1


def test_without_the_queue_the_rest_is_still_told(client: TestClient, queue: RememberingQueue) -> None:
    queue.down = True
    found = scraped(client)
    assert found["spicd_part_up", "queue"] == 0
    assert found["spicd_jobs", "accepted"] == 0


def test_without_the_database_the_rest_is_still_told(client: TestClient, catalog: Catalog) -> None:
    with catalog.database.write() as session:
        session.execute(text("ALTER TABLE tallies RENAME TO gone"))
    found = scraped(client)
    assert found["spicd_part_up", "database"] == 0
    assert found["spicd_part_up", "disk"] == 1
    assert ("spicd_disk_bytes", "free") in found
