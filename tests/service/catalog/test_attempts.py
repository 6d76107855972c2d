"""Attempts: a job is started again twice, and only while it is open."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from service.catalog.catalog import Catalog
from tests.support.samples import add_map

HOW = "the process of step m1-register ended by signal SIGKILL"


@pytest.fixture
def job_id(catalog: Catalog) -> str:
    return add_map(catalog, ready=False)


def test_the_first_two_attempts_that_are_lost_are_told_and_the_third_fails_the_job(
    catalog: Catalog, job_id: str
) -> None:
    catalog.jobs.start(job_id)
    for number in (2, 3):
        assert catalog.jobs.lose_attempt(job_id, HOW)
        job = catalog.jobs.get(job_id)
        assert (job.status, job.message) == ("running", f"started again ({number} of 3): {HOW}")
    assert not catalog.jobs.lose_attempt(job_id, HOW)
    problem = catalog.jobs.get(job_id).problem
    assert problem is not None
    assert problem.code == "worker_died"
    assert "SIGKILL" in problem.detail
    assert "3 attempts" in problem.detail
    assert catalog.maps.get("lobby").status == "failed"


def test_a_job_that_died_before_it_said_so_runs_from_then_on(catalog: Catalog, job_id: str) -> None:
    assert catalog.jobs.lose_attempt(job_id, HOW)
    job = catalog.jobs.get(job_id)
    assert (job.status, job.started) == ("running", job.updated)


def test_the_start_of_the_next_attempt_keeps_the_first_instant_and_the_share(
    catalog: Catalog, job_id: str
) -> None:
    catalog.jobs.start(job_id)
    catalog.jobs.report(job_id, message="registering", progress=0.5)
    before = catalog.jobs.get(job_id)
    catalog.jobs.lose_attempt(job_id, HOW)
    catalog.jobs.start(job_id)
    after = catalog.jobs.get(job_id)
    assert (after.started, after.progress) == (before.started, 50)


def test_what_is_put_back_costs_no_attempt(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.start(job_id)
    for _ in range(5):
        assert catalog.jobs.put_back(job_id)
    assert catalog.jobs.get(job_id).status == "running"
    assert catalog.jobs.lose_attempt(job_id, HOW)
    assert "(2 of 3)" in catalog.jobs.get(job_id).message


@pytest.mark.parametrize("end", ["succeed", "dismiss"])
def test_a_job_that_ended_is_not_started_again(catalog: Catalog, job_id: str, end: str) -> None:
    catalog.jobs.start(job_id)
    getattr(catalog.jobs, end)(job_id)
    ended = catalog.jobs.get(job_id)
    assert not catalog.jobs.lose_attempt(job_id, HOW)
    assert not catalog.jobs.put_back(job_id)
    assert catalog.jobs.get(job_id) == ended


def test_a_job_that_is_gone_is_not_started_again(catalog: Catalog) -> None:
    assert not catalog.jobs.lose_attempt("job-nowhere", HOW)
    assert not catalog.jobs.put_back("job-nowhere")


def test_of_five_that_lose_a_job_at_once_two_start_it_again(catalog: Catalog, job_id: str) -> None:
    with ThreadPoolExecutor(5) as pool:
        answers = list(pool.map(lambda _: catalog.jobs.lose_attempt(job_id, HOW), range(5)))
    assert answers.count(True) == 2
    assert catalog.jobs.get(job_id).status == "failed"
