"""Jobs: states that end stay ended, whoever comes late, and an open job is started again twice."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from service.catalog.catalog import Catalog
from service.catalog.records import JobStatus, Problem
from service.errors import Conflict, NotFound
from tests.support.samples import add_map, add_survey

HOW = "the process of step m1-register ended by signal SIGKILL"
PROBLEM = Problem(code="registration_failed", detail="scan hall.pcd: fitness 0.12 is below 0.55")


@pytest.fixture
def job_id(catalog: Catalog) -> str:
    return add_map(catalog, ready=False)


def test_a_job_waits_then_runs_then_succeeds_with_its_map(catalog: Catalog, job_id: str) -> None:
    assert catalog.jobs.get(job_id).status == "accepted"
    assert catalog.jobs.start(job_id)
    running = catalog.jobs.get(job_id)
    assert (running.status, running.finished) == ("running", None)
    assert catalog.jobs.succeed(job_id)
    done = catalog.jobs.get(job_id)
    assert (done.status, done.progress, done.started) == ("successful", 100, running.started)
    assert done.started is not None
    assert done.finished is not None
    assert done.created <= done.started <= done.finished == done.updated
    assert catalog.maps.get("lobby").status == "ready"


def test_a_second_start_keeps_the_first_instant(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.start(job_id)
    first = catalog.jobs.get(job_id).started
    assert catalog.jobs.start(job_id)
    assert catalog.jobs.get(job_id).started == first


def test_progress_is_the_share_in_percent_and_never_falls(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.start(job_id)
    shown = []
    for share in (0.1, 0.424, 0.2, 1.7, -1):
        assert catalog.jobs.report(job_id, message="registration", progress=share)
        shown.append(catalog.jobs.get(job_id).progress)
    assert shown == [10, 42, 42, 100, 100]


def test_a_failed_job_carries_its_problem_and_fails_its_map(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.start(job_id)
    assert catalog.jobs.fail(job_id, PROBLEM)
    assert catalog.jobs.get(job_id).problem == PROBLEM
    failed = catalog.maps.get("lobby")
    assert (failed.status, failed.problem) == ("failed", PROBLEM)


def test_a_failed_survey_leaves_its_map_ready(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    catalog.jobs.fail(job_id, PROBLEM)
    assert catalog.surveys.get(survey_id).status == "failed"
    assert catalog.maps.get("lobby").status == "ready"


END = {
    "successful": lambda jobs, job_id: jobs.succeed(job_id),
    "failed": lambda jobs, job_id: jobs.fail(job_id, PROBLEM),
    "dismissed": lambda jobs, job_id: jobs.dismiss(job_id),
}


@pytest.mark.parametrize("status", END)
def test_nothing_leaves_a_terminal_state(catalog: Catalog, job_id: str, status: JobStatus) -> None:
    END[status](catalog.jobs, job_id)
    ended = catalog.jobs.get(job_id)
    assert ended.status == status
    assert not catalog.jobs.start(job_id)
    assert not catalog.jobs.report(job_id, message="late", progress=0.5)
    assert not catalog.jobs.succeed(job_id)
    assert not catalog.jobs.fail(job_id, Problem(code="internal", detail="late"))
    if status == "dismissed":
        catalog.jobs.dismiss(job_id)
    else:
        with pytest.raises(Conflict, match=status):
            catalog.jobs.dismiss(job_id)
    assert catalog.jobs.get(job_id) == ended
    assert ended.status == status


def test_of_many_that_end_a_job_at_once_exactly_one_does(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.start(job_id)
    together = Barrier(8)

    def end(number: int) -> bool:
        together.wait()
        if number % 2:
            return catalog.jobs.succeed(job_id)
        return catalog.jobs.fail(job_id, Problem(code="internal", detail=str(number)))

    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(end, range(8)))
    assert won.count(True) == 1
    winner = won.index(True)
    status = catalog.jobs.get(job_id).status
    assert status == ("successful" if winner % 2 else "failed")
    assert catalog.maps.get("lobby").status == ("ready" if winner % 2 else "failed")


def test_reports_that_race_with_a_dismissal_never_undo_it(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.start(job_id)
    together = Barrier(5)

    def report(number: int) -> None:
        together.wait()
        for share in range(10):
            catalog.jobs.start(job_id)
            catalog.jobs.report(job_id, message=f"stage {number}", progress=share / 10)
        if not catalog.jobs.report(job_id, message="last", progress=1):
            catalog.jobs.succeed(job_id)

    def dismiss(_: int) -> None:
        together.wait()
        catalog.jobs.dismiss(job_id)

    with ThreadPoolExecutor(5) as pool:
        list(pool.map(lambda number: (dismiss if number == 4 else report)(number), range(5)))
    found = catalog.jobs.get(job_id)
    assert (found.status, found.message) == ("dismissed", "the job was dismissed")
    assert catalog.maps.get("lobby").status == "failed"


def test_a_job_that_is_gone_tells_its_worker_to_stop(catalog: Catalog, job_id: str) -> None:
    catalog.maps.delete("lobby")
    assert not catalog.jobs.start(job_id)
    assert not catalog.jobs.report(job_id, message="late", progress=0.5)
    assert not catalog.jobs.fail(job_id, PROBLEM)
    with pytest.raises(NotFound):
        catalog.jobs.get(job_id)


def test_jobs_are_counted_by_state(catalog: Catalog, job_id: str) -> None:
    add_map(catalog, "hall")
    assert catalog.jobs.counts() == {"accepted": 1, "successful": 1}


def test_an_unexpected_error_shows_its_type_alone() -> None:
    problem = Problem.of(RuntimeError("postgresql://user:secret@host"))
    assert problem.code == "internal"
    assert "RuntimeError" in problem.detail
    assert "secret" not in problem.detail


# attempts: an open job is started again twice


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
