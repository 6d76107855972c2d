"""What is written at the head of a picture."""

from __future__ import annotations

import numpy as np
import pytest

from worker.pipeline.results import sheet
from worker.pipeline.results.sheet import LeftOut, left_out_lines, standing

WIDTH = 7.6  # inches


def left_out(count: int) -> list[LeftOut]:
    return [LeftOut(name=f"visit-{n}.pcd", reason="other_place", detail="-") for n in range(count)]


def test_a_scan_that_was_left_out_is_named_with_its_reason() -> None:
    assert left_out_lines(left_out(1), WIDTH) == ["left out: visit-0.pcd (other place)"]
    assert left_out_lines([], WIDTH) == []


def test_a_scan_that_an_earlier_release_left_out_is_named_alone() -> None:
    one = LeftOut(name="visit.pcd", reason="", detail="fitness 0.10")
    assert left_out_lines([one], WIDTH) == ["left out: visit.pcd"]


def test_of_many_scans_those_that_have_no_room_are_counted() -> None:
    (line,) = left_out_lines(left_out(40), WIDTH)
    assert line.startswith("left out: visit-0.pcd (other place), visit-1.pcd")
    shown = line.count("other place")
    assert line.endswith(f", and {40 - shown} more")
    assert len(line) < WIDTH * 15


def test_points_of_a_large_cloud_are_counted_some_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(0, 3, (5000, 3)).astype(np.float32)
    whole = standing(points, 0.0, (0.0, 3.0, 0.0, 3.0))
    assert 0 < whole.sum() < 5000  # neither the floor nor what is above the head
    monkeypatch.setattr(sheet, "_AT_ONCE", 333)
    assert np.array_equal(standing(points, 0.0, (0.0, 3.0, 0.0, 3.0)), whole)
