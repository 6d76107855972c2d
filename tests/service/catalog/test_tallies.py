"""Tallies: counted with what they count, once, and by many at a time."""

from __future__ import annotations

import threading

import pytest

from service.catalog import tallies
from service.catalog.catalog import Catalog
from service.catalog.records import Problem, ScanOutcome
from tests.support.samples import IDENTITY, add_map, add_scan, add_survey, add_version, tile


def counted(catalog: Catalog, name: str) -> dict[tuple[str, ...], tuple[int, float]]:
    """Count and sum by the values of the labels, these in the order of their names."""
    with catalog.database.read() as session:
        samples = tallies.read(session)
    return {
        tuple(value for _, value in sorted(sample.labels.items())): (sample.count, sample.total)
        for sample in samples
        if sample.name == name
    }


def test_what_is_added_is_counted_and_summed_by_labels(catalog: Catalog) -> None:
    for value in (1.5, 2.0):
        with catalog.database.write() as session:
            tallies.add(session, "seconds", {"b": "x", "a": "y"}, value)
            tallies.add(session, "seconds", {"a": "y", "b": "x"}, 0.5)
            tallies.add(session, "seconds", {"a": "z", "b": "x"})
    assert counted(catalog, "seconds") == {("y", "x"): (4, 4.5), ("z", "x"): (2, 2.0)}


def test_what_is_rolled_back_counts_for_nothing(catalog: Catalog) -> None:
    with pytest.raises(RuntimeError), catalog.database.write() as session:
        tallies.add(session, "seconds", {})
        raise RuntimeError
    assert counted(catalog, "seconds") == {}


@pytest.mark.slow
def test_many_at_once_in_any_order_lose_nothing_and_wait_for_nobody_for_ever(catalog: Catalog) -> None:
    names = [f"name-{number}" for number in range(5)]

    def count(order: list[str]) -> None:
        for _ in range(20):
            with catalog.database.write() as session:
                for name in order:
                    tallies.add(session, name, {})

    threads = [threading.Thread(target=count, args=(order,)) for order in (names, names[::-1]) * 2]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert [counted(catalog, name) for name in names] == [{(): (80, 80.0)}] * 5


def test_a_step_is_counted_with_its_wait_and_its_time(catalog: Catalog) -> None:
    with catalog.database.write() as session:
        tallies.tally_step(
            session, kind="survey", step="score", outcome="successful", waited_s=2.0, ran_s=0.5
        )
        tallies.tally_attempt(session, kind="survey", step="score")
        tallies.tally_interruption(session, kind="survey", step="score")
    assert counted(catalog, "spicd_step_seconds") == {("survey", "successful", "score"): (1, 0.5)}
    assert counted(catalog, "spicd_step_wait_seconds") == {("survey", "successful", "score"): (1, 2.0)}
    assert counted(catalog, "spicd_step_attempts_lost") == {("survey", "score"): (1, 1.0)}
    assert counted(catalog, "spicd_step_interruptions") == {("survey", "score"): (1, 1.0)}


def test_jobs_are_counted_once_by_how_they_ended(catalog: Catalog) -> None:
    job_id = add_map(catalog)
    catalog.jobs.succeed(job_id)  # a second run of the last step
    _, failed = add_survey(catalog, ready=False)
    catalog.jobs.fail(failed, Problem(code="no_scan_accepted", detail="none"))
    assert counted(catalog, "spicd_jobs_ended") == {
        ("map", "successful"): (1, 1.0),
        ("survey", "no_scan_accepted"): (1, 1.0),
    }


def test_scans_are_counted_once_also_where_a_step_runs_twice(catalog: Catalog) -> None:
    add_map(catalog)
    scans = [add_scan(catalog, name).scan_id for name in ("one", "two")]
    survey, _ = catalog.surveys.create("lobby", scan_ids=scans, model="spicd-net/1")
    outcomes = [
        ScanOutcome(scan_id=scans[0], accepted=True, fitness=0.9, rmse=0.02, map_from_scan=IDENTITY),
        ScanOutcome(scan_id=scans[1], accepted=False, reason="other_place"),
    ]
    for _ in range(2):
        catalog.surveys.save_outcomes(survey.survey_id, outcomes)
    found = counted(catalog, "spicd_scans_registered")
    assert found == {
        ("map", "accepted"): (1, 1.0),
        ("survey", "accepted"): (1, 1.0),
        ("survey", "other_place"): (1, 1.0),
    }
    assert counted(catalog, "spicd_registration_fitness")["survey",] == (1, 0.9)
    assert counted(catalog, "spicd_registration_rmse_metres")["survey",] == (1, 0.02)


def test_a_version_counts_its_new_scans_alone(catalog: Catalog) -> None:
    add_map(catalog)
    add_version(catalog)
    assert counted(catalog, "spicd_scans_registered") == {("map", "accepted"): (2, 2.0)}


def test_the_tiles_of_a_survey_and_the_share_observed_are_counted_once(catalog: Catalog) -> None:
    add_map(catalog)
    tiles = [
        tile(0, 0, observed_share=0.5),
        tile(0, 1),
        tile(1, 0, "unobserved"),
        tile(1, 1, observed_share=0.5),
    ]
    survey_id, _ = add_survey(catalog, tiles)
    catalog.surveys.save_result(survey_id, tiles=tiles, threshold=0.5)
    assert counted(catalog, "spicd_survey_tiles") == {("spicd-net/1",): (1, 4.0)}
    assert counted(catalog, "spicd_survey_observed_share") == {("spicd-net/1",): (1, 0.5)}


def test_each_run_of_a_step_is_counted_by_how_it_ended(catalog: Catalog) -> None:
    add_map(catalog)
    _, job_id = add_survey(catalog, ready=False)
    jobs = catalog.jobs
    jobs.begin(job_id, "register")
    jobs.lose_attempt(job_id, "register", "it crashed")
    jobs.begin(job_id, "register")
    jobs.interrupt(job_id, "register", "it was killed")
    jobs.begin(job_id, "register")
    jobs.put_back(job_id, "register", "gave way")
    run = jobs.begin(job_id, "register")
    assert run is not None
    assert jobs.advance(run)
    assert not jobs.advance(run)  # late
    jobs.begin(job_id, "score")
    jobs.fail(job_id, Problem(code="internal", detail="broken"), step="score")
    ended = {key: count for key, (count, _) in counted(catalog, "spicd_step_seconds").items()}
    outcomes = ("lost", "interrupted", "put_back", "successful")
    assert ended == {
        **{("survey", outcome, "register"): 1 for outcome in outcomes},
        ("survey", "internal", "score"): 1,
    }
    assert counted(catalog, "spicd_step_attempts_lost") == {("survey", "register"): (1, 1.0)}
    assert counted(catalog, "spicd_step_interruptions") == {("survey", "register"): (1, 1.0)}
    assert all(total >= 0 for _, total in counted(catalog, "spicd_step_wait_seconds").values())


def test_a_job_that_ends_while_no_worker_has_it_counts_no_run(catalog: Catalog) -> None:
    add_map(catalog)
    _, job_id = add_survey(catalog, ready=False)
    catalog.jobs.dismiss(job_id)
    assert counted(catalog, "spicd_step_seconds") == {}
    assert counted(catalog, "spicd_jobs_ended")["survey", "dismissed"] == (1, 1.0)
