"""When a long step gives way."""

from __future__ import annotations

import pytest

from worker.errors import GaveWay
from worker.reporting import Reporter, Turn


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_turn_lasts_twenty_seconds_and_longer_where_nobody_waits() -> None:
    clock, asked, waiting = Clock(), [], [False]

    def others_wait() -> bool:
        asked.append(clock.now)
        return waiting[0]

    turn = Turn(others_wait, clock=clock)
    for instant in (0.0, 19.9, 20.0, 20.5, 21.0):
        clock.now = instant
        turn.check()
    assert asked == [20.0, 21.0]  # once a second
    waiting[0], clock.now = True, 22.0
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
