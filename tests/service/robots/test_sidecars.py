"""What lies beside a scan, and poses as they are written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from service.poses import matrix_of
from service.robots.sidecars import SidecarError, read_sidecar

TURNED = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
HALF = 0.5**0.5


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    return tmp_path / "hall.ply"


@pytest.mark.parametrize(
    "text",
    [
        f"1 2 3 0 0 {HALF} {HALF}",
        f"# at the door\n1, 2, 3,  # metres\n0 0 {HALF} {HALF}\n",
        "0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n",
        json.dumps(TURNED),
        json.dumps([1, 2, 3, 0, 0, HALF, HALF]),
    ],
)
def test_a_quarter_turn_to_the_left_in_each_form(scan: Path, text: str) -> None:
    scan.with_name("hall.pose.txt").write_text(text)
    for row, wanted in zip(read_sidecar(scan)["pose"], TURNED, strict=True):
        assert row == pytest.approx(wanted, abs=1e-6)


def test_json_says_the_rest_too(scan: Path) -> None:
    said = {"pose": TURNED, "frame": "map", "captured_at": "2026-03-01T12:00:00Z", "device_id": "robot-7"}
    scan.with_name("hall.pose.json").write_text(json.dumps(said))
    assert read_sidecar(scan) == said
    scan.with_name("hall.pose.json").write_text('{"frame": null}')
    assert read_sidecar(scan) == {}


def test_without_one_nothing_is_said(scan: Path) -> None:
    scan.with_name("hall.json").write_text("of something else")
    assert read_sidecar(scan) == {}


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("hall.pose.txt", "1 2 3", "3 numbers"),
        ("hall.pose.txt", "1 2 3 0 0 0 nan", "norm nan"),
        ("hall.pose.txt", "1 2 3 0 0 1 1", "norm 1.414"),
        ("hall.pose.txt", "one", "'one' is no number"),
        ("hall.pose.json", "[1]", "no JSON object"),
        ("hall.pose.json", '{"poses": []}', "'poses' is none of pose"),
        ("hall.pose.json", '{"pose": [[1, 2], [3, 4]]}', "four rows"),
        ("hall.pose.json", '{"pose":', "no valid JSON at line 1, column 9"),
        ("hall.pose.txt", "2.O 0 0 0 0 0 1", "'2.O' is no number"),
        (
            "hall.pose.txt",
            "2 0 0 1 0 2 0 2 0 0 2 3 0 0 0 1",
            "scales by 2; its rotation part must be orthonormal",
        ),
        ("hall.pose.txt", "1 0 0 1 0 1 0 2 0 0 2 3 0 0 0 1", "rows have the lengths 1, 1, 2; its"),
        ("hall.pose.txt", "1 .1 0 1 0 1 0 2 0 0 1 3 0 0 0 1", "not at right angles"),
        ("hall.pose.txt", "1 0 0 1 0 1 0 2 0 0 -1 3 0 0 0 1", "mirrors"),
        ("hall.pose.txt", "1 0 0 0 0 1 0 0 0 0 1 0 1 2 3 1", "last row of a pose"),
        (
            "hall.pose.json",
            '{"pose": [["1", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}',
            "numbers alone",
        ),
        ("hall.pose.json", '{"captured_at": "yesterday"}', "captured_at 'yesterday' is no date"),
        ("hall.pose.json", '{"captured_at": "2026-03-01T12:00:00"}', "with its zone"),
        ("hall.pose.json", '{"captured_at": "2026-13-01T12:00:00Z"}', "is no date and time"),
    ],
)
def test_one_that_cannot_be_used_is_named(scan: Path, name: str, text: str, told: str) -> None:
    scan.with_name(name).write_text(text)
    with pytest.raises(SidecarError) as error:
        read_sidecar(scan)
    assert name in str(error.value)
    assert told in str(error.value)


def test_two_are_one_too_many(scan: Path) -> None:
    for name in ("hall.pose.txt", "hall.pose.json"):
        scan.with_name(name).write_text("")
    with pytest.raises(SidecarError, match="both tell"):
        read_sidecar(scan)


def test_a_quaternion_of_four_decimals_makes_a_rotation() -> None:
    rows = matrix_of([0, 0, 0, 0.1826, 0.3651, 0.5477, 0.7303])
    for i in range(3):
        for j in range(3):
            dot = sum(rows[i][k] * rows[j][k] for k in range(3))
            assert dot == pytest.approx(float(i == j), abs=1e-12)
