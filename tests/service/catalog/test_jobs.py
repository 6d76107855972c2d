"""Jobs: states that end stay ended, whoever comes late; a step has one run at a time, and is started again."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from threading import Barrier

import pytest
from sqlalchemy import update

from service.catalog.catalog import Catalog
from service.catalog.jobs import Run
from service.catalog.records import JobStatus, Problem
from service.catalog.sql import tables
from service.catalog.sql.tables import now
from service.errors import Conflict, NotFound
from tests.support.samples import add_map, add_scan, add_survey

HOW = "the process of step m1-register ended by signal SIGKILL"
PROBLEM = Problem(code="registration_failed", detail="scan hall.pcd: fitness 0.12 is below 0.55")


STALE = Run(job_id="job-nowhere", step="register", begun=now())


def begin(catalog: Catalog, job_id: str, step: str = "register") -> Run:
    """Begin a step that is due."""
    run = catalog.jobs.begin(job_id, step)
    assert run is not None
    return run


@pytest.fixture
def job_id(catalog: Catalog) -> str:
    return add_map(catalog, ready=False)


def test_a_job_waits_then_runs_then_succeeds_with_its_map(catalog: Catalog, job_id: str) -> None:
    assert catalog.jobs.get(job_id).status == "accepted"
    begin(catalog, job_id)
    running = catalog.jobs.get(job_id)
    assert (running.status, running.finished) == ("running", None)
    assert catalog.jobs.succeed(job_id)
    done = catalog.jobs.get(job_id)
    assert (done.status, done.progress, done.started) == ("successful", 100, running.started)
    assert done.started is not None
    assert done.finished is not None
    assert done.created <= done.started <= done.finished == done.updated
    assert catalog.maps.get("lobby").status == "ready"


def test_a_step_that_begins_again_keeps_the_first_instant(catalog: Catalog, job_id: str) -> None:
    begin(catalog, job_id)
    first = catalog.jobs.get(job_id).started
    catalog.jobs.put_back(job_id, "register", "gave way")
    begin(catalog, job_id)
    assert catalog.jobs.get(job_id).started == first


def test_progress_is_the_share_in_percent_and_never_falls(catalog: Catalog, job_id: str) -> None:
    run = begin(catalog, job_id)
    shown = []
    for share in (0.1, 0.424, 0.2, 1.7, -1):
        assert catalog.jobs.report(run, message="registration", progress=share)
        shown.append(catalog.jobs.get(job_id).progress)
    assert shown == [10, 42, 42, 100, 100]


def test_a_failed_job_carries_its_problem_and_fails_its_map(catalog: Catalog, job_id: str) -> None:
    begin(catalog, job_id)
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
    run = begin(catalog, job_id)
    END[status](catalog.jobs, job_id)
    ended = catalog.jobs.get(job_id)
    assert ended.status == status
    assert catalog.jobs.begin(job_id, "register") is None
    assert not catalog.jobs.report(run, message="late", progress=0.5)
    assert not catalog.jobs.advance(run)
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
    begin(catalog, job_id)
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
    together = Barrier(5)
    run = begin(catalog, job_id)

    def report(number: int) -> None:
        together.wait()
        for share in range(10):
            catalog.jobs.begin(job_id, "register")
            catalog.jobs.report(run, message=f"stage {number}", progress=share / 10)
        if not catalog.jobs.report(run, message="last", progress=1):
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
    run = begin(catalog, job_id)
    catalog.maps.delete("lobby")
    assert catalog.jobs.begin(job_id, "register") is None
    assert not catalog.jobs.report(run, message="late", progress=0.5)
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


# steps


def test_a_step_has_one_run_at_a_time(catalog: Catalog, job_id: str) -> None:
    assert catalog.jobs.begin(job_id, "encode") is None  # it is not due yet
    with ThreadPoolExecutor(5) as pool:
        runs = list(pool.map(lambda _: catalog.jobs.begin(job_id, "register"), range(5)))
    assert len([run for run in runs if run is not None]) == 1


def test_a_job_goes_on_to_the_next_step_with_its_attempts_anew(catalog: Catalog, job_id: str) -> None:
    begin(catalog, job_id)
    assert catalog.jobs.lose_attempt(job_id, "register", HOW)
    begin(catalog, job_id)
    assert catalog.jobs.interrupt(job_id, "register", HOW)
    run = begin(catalog, job_id)
    assert catalog.jobs.advance(run)
    job = catalog.jobs.get(job_id)
    assert (job.step, job.attempts, job.interruptions, job.status) == ("encode", 0, 0, "running")
    (due,) = catalog.jobs.open_jobs()
    assert (due.step, due.begun) == ("encode", None)
    assert catalog.jobs.begin(job_id, "register") is None
    assert not catalog.jobs.advance(run)


def test_behind_the_last_step_there_is_none(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.advance(begin(catalog, job_id))
    run = begin(catalog, job_id, "encode")
    assert not catalog.jobs.advance(run)
    assert catalog.jobs.get(job_id).step == "encode"


@pytest.mark.parametrize("ends", ["lose_attempt", "interrupt"])
def test_the_end_of_a_run_is_not_taken_for_that_of_a_later_step(
    catalog: Catalog, job_id: str, ends: str
) -> None:
    catalog.jobs.advance(begin(catalog, job_id))
    run = begin(catalog, job_id, "encode")
    assert not getattr(catalog.jobs, ends)(job_id, "register", HOW)
    assert not catalog.jobs.fail(job_id, PROBLEM, step="register")
    assert catalog.jobs.report(run, message="encoding", progress=0.5)


def test_who_looked_before_a_step_began_again_does_not_interrupt_it(catalog: Catalog, job_id: str) -> None:
    first = begin(catalog, job_id)
    assert catalog.jobs.interrupt(job_id, "register", HOW, begun=first.begun)
    second = begin(catalog, job_id)
    assert not catalog.jobs.interrupt(job_id, "register", HOW, begun=first.begun)
    assert catalog.jobs.report(second, message="registering", progress=0.5)


@pytest.mark.parametrize("ends", ["lose_attempt", "interrupt", "put_back"])
def test_the_late_word_of_a_run_changes_nothing_of_the_one_that_took_its_place(
    catalog: Catalog, job_id: str, ends: str
) -> None:
    first = begin(catalog, job_id)
    catalog.jobs.interrupt(job_id, "register", HOW, begun=first.begun)
    second = begin(catalog, job_id)
    assert not getattr(catalog.jobs, ends)(job_id, "register", HOW, begun=first.begun)
    assert not catalog.jobs.fail(job_id, PROBLEM, step="register", begun=first.begun)
    assert not catalog.jobs.succeed(job_id, run=first)
    assert catalog.jobs.report(second, message="registering", progress=0.5)
    assert catalog.jobs.get(job_id).attempts == 0


@pytest.mark.parametrize("ends", ["interrupt", "put_back"])
def test_a_step_that_nobody_has_begun_waits_on_as_it_was(catalog: Catalog, job_id: str, ends: str) -> None:
    before = catalog.jobs.get(job_id)
    assert not getattr(catalog.jobs, ends)(job_id, "register", HOW)
    assert catalog.jobs.get(job_id) == before


# a failed job can be run again


def test_a_failed_job_goes_on_with_the_step_that_it_failed_in(catalog: Catalog) -> None:
    add_map(catalog)
    survey_id, job_id = add_survey(catalog, ready=False)
    catalog.jobs.advance(begin(catalog, job_id))
    begin(catalog, job_id, "score")
    catalog.jobs.fail(job_id, Problem(code="disk_full", detail="the disk is full"))
    job = catalog.jobs.run_again(job_id)
    assert (job.status, job.step, job.problem, job.finished) == ("running", "score", None, None)
    survey = catalog.surveys.get(survey_id)
    assert (survey.status, survey.problem) == ("running", None)
    assert catalog.jobs.run_again(job_id) == job  # sent twice
    run = begin(catalog, job_id, "score")
    assert catalog.jobs.advance(run)


def test_a_job_that_ended_otherwise_is_not_run_again(catalog: Catalog, job_id: str) -> None:
    catalog.jobs.dismiss(job_id)
    with pytest.raises(Conflict, match="dismissed"):
        catalog.jobs.run_again(job_id)
    with pytest.raises(NotFound):
        catalog.jobs.run_again("job-nowhere")


def test_a_failed_build_is_not_run_again_beside_another_of_the_same_map(catalog: Catalog) -> None:
    add_map(catalog)
    scans = [add_scan(catalog, name).scan_id for name in ("more", "most")]
    _, failed = catalog.versions.create("lobby", scan_ids=scans[:1])
    catalog.jobs.fail(failed.job_id, PROBLEM)
    _, building = catalog.versions.create("lobby", scan_ids=scans[1:])
    with pytest.raises(Conflict, match=building.job_id):
        catalog.jobs.run_again(failed.job_id)
    catalog.jobs.dismiss(building.job_id)
    assert catalog.jobs.run_again(failed.job_id).status == "accepted"


# attempts: a step is started again twice after a fault of its own, and twenty times after one from outside


def test_the_first_two_attempts_that_are_lost_are_told_and_the_third_fails_the_job(
    catalog: Catalog, job_id: str
) -> None:
    for number in (2, 3):
        begin(catalog, job_id)
        assert catalog.jobs.lose_attempt(job_id, "register", HOW)
        job = catalog.jobs.get(job_id)
        assert (job.status, job.message) == ("running", f"started again ({number} of 3): {HOW}")
    begin(catalog, job_id)
    assert not catalog.jobs.lose_attempt(job_id, "register", HOW)
    problem = catalog.jobs.get(job_id).problem
    assert problem is not None
    assert problem.code == "worker_died"
    assert "SIGKILL" in problem.detail
    assert "3 attempts" in problem.detail
    assert catalog.maps.get("lobby").status == "failed"


def test_an_interruption_costs_no_attempt_and_the_twentieth_fails_the_job(
    catalog: Catalog, job_id: str
) -> None:
    for _ in range(19):
        begin(catalog, job_id)
        assert catalog.jobs.interrupt(job_id, "register", HOW)
    job = catalog.jobs.get(job_id)
    assert (job.status, job.attempts, job.interruptions) == ("running", 0, 19)
    begin(catalog, job_id)
    assert not catalog.jobs.interrupt(job_id, "register", HOW)
    problem = catalog.jobs.get(job_id).problem
    assert problem is not None
    assert (problem.code, "20 interruptions" in problem.detail) == ("worker_died", True)


def test_a_step_that_is_interrupted_again_and_again_waits_longer_each_time(
    catalog: Catalog, job_id: str
) -> None:
    waits = []
    for _ in range(10):
        begin(catalog, job_id)
        before = now()
        catalog.jobs.interrupt(job_id, "register", HOW)
        (job,) = catalog.jobs.open_jobs()
        waits.append(round((job.due - before).total_seconds()))
    assert waits == [0, 0, 0, 2, 4, 8, 16, 30, 30, 30]


def test_a_job_that_died_before_it_said_so_runs_from_then_on(catalog: Catalog, job_id: str) -> None:
    assert catalog.jobs.lose_attempt(job_id, "register", HOW)
    job = catalog.jobs.get(job_id)
    assert (job.status, job.started) == ("running", job.updated)


def test_the_start_of_the_next_attempt_keeps_the_first_instant_and_the_share(
    catalog: Catalog, job_id: str
) -> None:
    run = begin(catalog, job_id)
    catalog.jobs.report(run, message="registering", progress=0.5)
    before = catalog.jobs.get(job_id)
    catalog.jobs.lose_attempt(job_id, "register", HOW)
    begin(catalog, job_id)
    after = catalog.jobs.get(job_id)
    assert (after.started, after.progress) == (before.started, 50)


def test_what_is_put_back_costs_nothing(catalog: Catalog, job_id: str) -> None:
    for _ in range(25):
        begin(catalog, job_id)
        assert catalog.jobs.put_back(job_id, "register", "gave way")
    job = catalog.jobs.get(job_id)
    assert (job.status, job.message, job.attempts, job.interruptions) == ("running", "gave way", 0, 0)


@pytest.mark.parametrize("end", ["succeed", "dismiss"])
def test_a_job_that_ended_is_not_started_again(catalog: Catalog, job_id: str, end: str) -> None:
    begin(catalog, job_id)
    getattr(catalog.jobs, end)(job_id)
    ended = catalog.jobs.get(job_id)
    assert not catalog.jobs.lose_attempt(job_id, "register", HOW)
    assert not catalog.jobs.interrupt(job_id, "register", HOW)
    assert not catalog.jobs.put_back(job_id, "register", HOW)
    assert catalog.jobs.get(job_id) == ended


def test_a_job_that_is_gone_is_not_started_again(catalog: Catalog) -> None:
    assert not catalog.jobs.lose_attempt("job-nowhere", "register", HOW)
    assert not catalog.jobs.interrupt("job-nowhere", "register", HOW)
    assert not catalog.jobs.put_back("job-nowhere", "register", HOW)
    assert not catalog.jobs.advance(STALE)


def test_of_five_that_lose_a_job_at_once_two_start_it_again(catalog: Catalog, job_id: str) -> None:
    with ThreadPoolExecutor(5) as pool:
        answers = list(pool.map(lambda _: catalog.jobs.lose_attempt(job_id, "register", HOW), range(5)))
    assert answers.count(True) == 2
    assert catalog.jobs.get(job_id).status == "failed"


# who waits


def test_jobs_that_wait_are_counted_by_owner_and_surveys_that_wait_by_queue(catalog: Catalog) -> None:
    add_map(catalog)
    scan = add_scan(catalog, "visit").scan_id
    _, job = catalog.surveys.create("lobby", scan_ids=[scan], model="spicd-net/1", device_id="robot-1")
    assert (catalog.jobs.waiting(), catalog.jobs.waiting("robot-1"), catalog.jobs.waiting("robot-2")) == (
        1,
        1,
        0,
    )
    assert not catalog.jobs.surveys_wait("geometry")  # a worker that is free is about to begin it
    _wait_for_2_s(catalog)
    assert catalog.jobs.surveys_wait("geometry")
    assert not catalog.jobs.surveys_wait("inference")
    run = begin(catalog, job.job_id)
    assert (catalog.jobs.waiting(), catalog.jobs.surveys_wait("geometry")) == (0, False)
    catalog.jobs.advance(run)
    _wait_for_2_s(catalog)
    assert catalog.jobs.surveys_wait("inference")


def _wait_for_2_s(catalog: Catalog) -> None:
    with catalog.database.write() as session:
        session.execute(update(tables.Job).values(due=now() - timedelta(seconds=2)))
