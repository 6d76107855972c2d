"""Who comes next, told of jobs that wait and run; and what a dispatcher makes of catalog and queue."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import pytest

from service.catalog.catalog import Catalog
from service.catalog.jobs import OpenJob
from service.catalog.steps import JobKind
from service.dispatch import TAKEN_S, Dispatcher, fair_order, queue_positions
from service.errors import DiskFull
from service.queue import Claim, QueueState, Snapshot
from tests.support.samples import NOON, RememberingQueue, add_map, add_scan


def waits(
    job_id: str,
    kind: JobKind = "survey",
    *,
    owner: str = "robot",
    at_s: float = 0,
    step: str = "",
    begun: bool = False,
) -> OpenJob:
    """A job whose step waits; `begun` says that one before it is over."""
    due = NOON + timedelta(seconds=at_s)
    return OpenJob(
        job_id=job_id,
        kind=kind,
        step=step or ("pack" if kind == "model" else "register"),
        status="running" if begun else "accepted",
        owner=owner,
        created=due,
        due=due,
        begun=None,
    )


def runs(job: OpenJob) -> OpenJob:
    """The same with a worker at it."""
    return replace(job, status="running", begun=job.due)


def order(*jobs: OpenJob, at_s: float = 60) -> str:
    return " ".join(job.job_id for job in fair_order(jobs, NOON + timedelta(seconds=at_s)))


def test_what_was_begun_is_finished_first_then_surveys_then_builds_then_trainings() -> None:
    training, build = waits("t", "model"), waits("b", "map", at_s=1)
    survey, export = waits("s", at_s=2), waits("e", at_s=3, step="export", begun=True)
    assert order(training, build, survey, export) == "e s b t"


def test_a_step_that_a_worker_has_waits_for_nothing() -> None:
    assert order(runs(waits("a")), waits("b", at_s=1)) == "b"


def test_owners_take_turns() -> None:
    many = [waits(f"a{n}", owner="a", at_s=n) for n in range(4)]
    few = [waits(f"b{n}", owner="b", at_s=10 + n) for n in range(2)]
    assert order(*many, *few) == "a0 b0 a1 b1 a2 a3"


def test_who_has_surveys_under_way_lets_others_begin() -> None:
    under_way = [runs(waits(f"r{n}", owner="a")) for n in range(2)]
    assert order(*under_way, waits("a0", owner="a"), waits("b0", owner="b", at_s=5)) == "b0 a0"


def test_a_build_that_waited_for_two_minutes_goes_before_the_surveys_that_came_later() -> None:
    build, later = waits("b", "map", owner="hall"), waits("s", at_s=100)
    assert order(build, later, at_s=110) == "s b"
    assert order(build, later, at_s=121) == "b s"


def test_positions_are_those_in_the_steps_own_queue() -> None:
    score = waits("c", step="score", begun=True)
    jobs = [waits("a", at_s=1), waits("b", at_s=2), score, runs(waits("d"))]
    assert queue_positions(jobs, NOON) == {"a": 1, "b": 2, "c": 1}


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class OneQueue(RememberingQueue):
    """A queue whose state a test sets; it keeps what was arranged, released and dropped."""

    def __init__(self, **state: object) -> None:
        super().__init__(state=QueueState(**state))  # type: ignore[arg-type]
        self.done: list[str] = []

    def snapshot(self) -> Snapshot:
        return Snapshot(queues={"geometry": self.state})

    def release(self, claims: object) -> None:
        self.done += [f"released {claim.step}" for claim in claims]  # type: ignore[attr-defined]

    def drop_taken(self, queue: str, name: str) -> None:
        self.done.append(f"dropped {name}")

    def forget_worker(self, name: str) -> None:
        self.done.append(f"forgot {name}")


@pytest.fixture
def survey(catalog: Catalog) -> str:
    """A survey that waits; its job."""
    add_map(catalog)
    scan = add_scan(catalog, "visit").scan_id
    return catalog.surveys.create("lobby", scan_ids=[scan], model="spicd-net/1")[1].job_id


def test_no_more_steps_wait_than_there_are_workers(catalog: Catalog, survey: str) -> None:
    further = [add_map(catalog, name, ready=False) for name in ("a", "b")]
    for workers, expected in (((), [survey]), (("w1", "w2"), [survey, further[0]])):
        queue = OneQueue(answering=workers)
        Dispatcher(catalog.jobs, queue).hand_over()
        assert queue.submitted == [(job_id, "register") for job_id in expected]


def test_a_step_that_is_held_is_left_alone(catalog: Catalog, survey: str) -> None:
    run = catalog.jobs.begin(survey, "register")
    assert run is not None
    queue = OneQueue(claims=(Claim(step=f"{survey}-register", execution="1", worker="w1"),))
    Dispatcher(catalog.jobs, queue).run()
    assert (queue.submitted, queue.done) == ([], [])
    assert catalog.jobs.report(run, message="registering", progress=0.1)


def test_a_step_that_begun_and_nobody_holds_is_interrupted_and_handed_over(
    catalog: Catalog, survey: str
) -> None:
    catalog.jobs.begin(survey, "register")
    queue = OneQueue()
    Dispatcher(catalog.jobs, queue).run()
    assert queue.submitted == [(survey, "register")]
    assert catalog.jobs.get(survey).interruptions == 1


def test_a_claim_that_has_ended_is_cleared_away(catalog: Catalog, survey: str) -> None:
    catalog.jobs.begin(survey, "register")
    queue = OneQueue(claims=(Claim(step=f"{survey}-register", execution="1", worker=None),))
    Dispatcher(catalog.jobs, queue).run()
    assert queue.done == [f"released {survey}-register"]
    assert queue.submitted == [(survey, "register")]


def test_a_step_that_was_taken_is_waited_for_some_seconds(catalog: Catalog, survey: str) -> None:
    clock, queue = Clock(), OneQueue(taken=(f"{survey}-register",))
    dispatcher = Dispatcher(catalog.jobs, queue, clock=clock)
    dispatcher.run()
    clock.now = TAKEN_S - 0.1
    dispatcher.run()
    assert (queue.done, queue.submitted) == ([], [])
    clock.now = TAKEN_S
    dispatcher.run()
    assert queue.done == [f"dropped {survey}-register"]


def test_a_step_that_comes_to_be_taken_again_is_waited_for_anew(catalog: Catalog, survey: str) -> None:
    clock, queue = Clock(), OneQueue(taken=(f"{survey}-register",))
    dispatcher = Dispatcher(catalog.jobs, queue, clock=clock)
    dispatcher.run()
    taken, queue.state = queue.state, QueueState()
    dispatcher.run()
    clock.now, queue.state = TAKEN_S + 1, taken
    dispatcher.run()
    assert queue.done == []


def test_a_worker_that_stays_silent_is_forgotten_at_last(catalog: Catalog) -> None:
    clock, queue = Clock(), OneQueue(silent=("w1",))
    dispatcher = Dispatcher(catalog.jobs, queue, clock=clock)
    dispatcher.run()
    clock.now = 599
    dispatcher.run()
    assert queue.done == []
    clock.now = 601
    dispatcher.run()
    assert queue.done == ["forgot w1"]


def test_a_step_that_was_put_off_is_not_handed_over_before_its_time(catalog: Catalog, survey: str) -> None:
    for _ in range(6):
        catalog.jobs.begin(survey, "register")
        catalog.jobs.interrupt(survey, "register", "killed")
    queue = OneQueue()
    Dispatcher(catalog.jobs, queue).run()
    assert queue.submitted == []


def test_what_is_due_is_handed_over_also_where_what_was_lost_cannot_be_recorded(
    catalog: Catalog, survey: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = add_map(catalog, "hall", ready=False)
    catalog.jobs.begin(lost, "register")

    def full(*_: object, **__: object) -> bool:
        raise DiskFull("no space")

    monkeypatch.setattr(type(catalog.jobs), "interrupt", full)
    queue = OneQueue()
    with pytest.raises(DiskFull):
        Dispatcher(catalog.jobs, queue).run()
    assert queue.submitted == [(survey, "register")]
