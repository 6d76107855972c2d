from __future__ import annotations

import time

import pytest

from worker.benchmarks.timing import StageClock


def test_time_between_reports_counts_for_the_stage_before(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10.0, 11.0, 13.0, 16.0, 20.0, 25.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(times))
    heard: list[tuple[str, float]] = []
    clock = StageClock(lambda stage, share: heard.append((stage, share)), prefix="map: ")
    for stage, share in (("pairs", 0.0), ("pairs", 0.5), ("graph", 0.0), ("pairs", 1.0)):
        clock(stage, share)
    assert clock.seconds() == {"reading": 1.0, "pairs": 2.0 + 3.0 + 5.0, "graph": 4.0, "total": 15.0}
    assert heard[1] == ("map: pairs", 0.5)
