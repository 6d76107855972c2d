"""The examples do what they say; that of the client runs in tests/acceptance, where there is a service."""

from __future__ import annotations

from pathlib import Path

import pytest

from examples import pipeline
from worker.cloud.formats.scan import read_scan


@pytest.mark.slow
def test_the_example_of_the_pipeline_lists_changed_tiles_and_writes_the_cloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    pipeline.main([])
    printed = capsys.readouterr().out.splitlines()
    assert printed
    assert all(line.startswith("tile_") for line in printed)
    assert len(read_scan(tmp_path / "changes.ply").points) > 5_000
