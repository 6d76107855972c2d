from __future__ import annotations

import pytest

from worker import reporting
from worker.errors import Cancelled, GaveWay
from worker.reporting import Reporter, Turn

SPANS = {"registering": (0.0, 0.25), "tiling": (0.25, 0.5), "scoring": (0.5, 1.0)}


class Clock:
    """Stands in for `time`: it moves when a test says so."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


class Written:
    """What the database was told; `wanted` is its answer."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, float]] = []
        self.wanted = True

    def __call__(self, stage: str, share: float) -> bool:
        self.rows.append((stage, share))
        return self.wanted


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(reporting, "time", clock)
    return clock


def test_half_of_the_second_half_is_three_quarters_of_the_job(clock: Clock) -> None:
    written = Written()
    Reporter(SPANS, written)("scoring", 0.5)
    assert written.rows == [("scoring", 0.75)]


def test_a_job_goes_from_0_to_1_without_a_gap_between_its_stages(clock: Clock) -> None:
    written = Written()
    report = Reporter(SPANS, written)
    for stage in SPANS:
        report(stage, 0.0)
        report(stage, 1.0)
    assert [share for _, share in written.rows] == [0.0, 0.25, 0.25, 0.5, 0.5, 1.0]


def test_a_thousand_reports_in_three_seconds_are_written_ten_times(clock: Clock) -> None:
    written = Written()
    report = Reporter(SPANS, written)
    for step in range(1000):
        clock.now = 100.0 + step * 0.003
        report("scoring", step / 1000)
    assert len(written.rows) == 10


def test_a_new_stage_and_the_end_of_one_are_written_at_once(clock: Clock) -> None:
    written = Written()
    report = Reporter(SPANS, written)
    report("registering", 0.0)
    report("registering", 0.5)  # too soon
    report("registering", 1.0)
    report("tiling", 0.0)
    assert written.rows == [("registering", 0.0), ("registering", 0.25), ("tiling", 0.25)]


def test_a_job_that_nobody_waits_for_is_cancelled_at_the_next_write(clock: Clock) -> None:
    written = Written()
    report = Reporter(SPANS, written)
    report("registering", 0.1)
    written.wanted = False
    report("registering", 0.2)  # too soon to ask
    clock.now += 1.0
    with pytest.raises(Cancelled):
        report("registering", 0.3)


def test_an_unknown_stage_is_a_fault_and_not_a_guess(clock: Clock) -> None:
    with pytest.raises(KeyError):
        Reporter(SPANS, Written())("dreaming", 0.5)


def test_a_turn_lasts_twenty_seconds_and_longer_where_nobody_waits() -> None:
    now, asked, waiting = [0.0], [], [False]

    def others_wait() -> bool:
        asked.append(now[0])
        return waiting[0]

    turn = Turn(others_wait, clock=lambda: now[0])
    for instant in (0.0, 19.9, 20.0, 20.5, 21.0):
        now[0] = instant
        turn.check()
    assert asked == [20.0, 21.0]  # once a second
    waiting[0], now[0] = True, 22.0
    with pytest.raises(GaveWay):
        turn.check()


def test_a_step_gives_way_within_the_stages_that_keep_what_they_did_and_not_at_their_ends() -> None:
    def give_way() -> None:
        raise GaveWay("others go first")

    spans = {"registering": (0.0, 0.5), "fusing": (0.5, 1.0)}
    report = Reporter(spans, lambda _stage, _share: True, give_way={"registering": give_way})
    report("registering", 0.0)
    report("registering", 1.0)
    report("fusing", 0.5)
    with pytest.raises(GaveWay):
        report("registering", 0.5)
