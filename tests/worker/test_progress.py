"""Progress of work whose length nobody knows."""

from __future__ import annotations

from itertools import pairwise

import pytest

from worker.progress import advancing


def test_work_of_unknown_length_goes_on_ever_more_slowly_and_never_ends_by_itself() -> None:
    told: list[tuple[str, float]] = []
    step = advancing(lambda *at: told.append(at), "registering", 0.2, 0.6, half=10)
    for _ in range(1001):
        step()
    shares = [share for _, share in told]
    assert {stage for stage, _ in told} == {"registering"}
    assert [shares[0], shares[10]] == pytest.approx([0.2, 0.4])
    assert all(after - before > 0 for before, after in pairwise(shares))
    assert 0.59 < shares[-1] < 0.6
