"""The marks by which tests are chosen."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import conftest as marks


def test_what_is_called_slow_is_there() -> None:
    assert [name for name in marks.SLOW if not (marks.TESTS / name).exists()] == []


def test_a_test_is_fast_or_slow_and_its_own_mark_stays(request: pytest.FixtureRequest) -> None:
    for item in request.session.items:
        assert (item.get_closest_marker("fast") is None) != (item.get_closest_marker("slow") is None)
        asks = "shared_data" in getattr(item, "fixturenames", ())
        assert (item.get_closest_marker("real_data") is not None) == asks


@pytest.mark.parametrize(("missing", "skipped"), [("folder/scan.pcd", True), ("elsewhere/scan.pcd", False)])
def test_a_missing_file_of_the_real_scans_skips_and_any_other_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str, skipped: bool
) -> None:
    monkeypatch.setenv("SPICD_TEST_DATA", str(tmp_path / "folder"))
    expected = pytest.skip.Exception if skipped else FileNotFoundError
    with pytest.raises(expected), marks.skipped_without_its_file():
        (tmp_path / missing).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("processes", ["0", "2"])
def test_the_end_of_a_run_tells_what_was_skipped_for_want_of_real_scans(
    tmp_path: Path, processes: str
) -> None:
    command = [sys.executable, "-m", "pytest", "-n", processes, "-m", "real_data", "tests/test_docs.py"]
    environment = {**os.environ, "SPICD_TEST_DATA": str(tmp_path / "nowhere")}
    run = subprocess.run(
        command, cwd=marks.TESTS.parent, env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout
    *_, line, _last = run.stdout.splitlines()
    assert line == "1 test was skipped for want of real scans; docs/test-data.md says where to get them"
