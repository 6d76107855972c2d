"""The picture of a survey of which no scan was accepted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from worker.pipeline.results.refusal import _refusals, draw_refusal
from worker.pipeline.results.sheet import LeftOut

ROOM = np.random.default_rng(0).uniform((0, 0, 0), (6, 4, 2.5), (20_000, 3)).astype(np.float32)


def refused(count: int) -> list[LeftOut]:
    detail = "it fits the floor and the walls, and 31% of it stands where the map's scans saw through"
    return [LeftOut(name=f"visit {n}.pcd", reason="other_place", detail=detail) for n in range(count)]


def rows(path: Path, left_out: list[LeftOut]) -> int:
    draw_refusal(path, ROOM, left_out, title="Map hall: survey of today")
    return int(np.asarray(imread(path)).shape[0])


@pytest.mark.slow
def test_each_reason_has_its_lines_over_the_map(tmp_path: Path) -> None:
    one, three = (rows(tmp_path / "p.png", refused(count)) for count in (1, 3))
    assert three > one + 2 * 2 * 0.2 * 130 - 5


@pytest.mark.slow
@pytest.mark.parametrize("name", [r"$\\frac{a$.pcd", "a_$b^{.ply", "x" * 255])
def test_any_name_of_a_file_can_be_drawn(tmp_path: Path, name: str) -> None:
    assert rows(tmp_path / "p.png", [LeftOut(name=name, reason="unreadable", detail=f"{name}: cut")]) > 200


def test_of_very_many_scans_the_rest_is_counted() -> None:
    lines = [line for line, _ in _refusals(refused(100), 100)]
    assert len(lines) <= 25
    named = sum(line.endswith(": other place") for line in lines)
    assert lines[-1] == f"and {100 - named} more"
