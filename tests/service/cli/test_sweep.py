"""`spicd sweep`: lists what goes, and removes it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from service.catalog.catalog import Catalog, open_catalog
from service.cli.main import main
from service.errors import NotFound
from service.settings import Settings
from tests.service.catalog.files.test_retention import aged
from tests.support.samples import add_map, add_scan


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Catalog:
    """A data folder with a map and a scan that nothing uses, both old."""
    monkeypatch.setenv("SPICD_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("SPICD_KEEP_SCANS_DAYS", "30")
    catalog = open_catalog(Settings())
    add_map(catalog)
    add_scan(catalog, "idle")
    aged(catalog)
    return catalog


def spicd(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    return int(ended.value.code or 0)


def test_a_dry_run_lists_what_would_go_and_changes_nothing(
    kept: Catalog, capsys: pytest.CaptureFixture[str]
) -> None:
    idle = add_scan(kept, "idle").scan_id
    aged(kept)
    with kept.database.write() as session:
        session.connection().exec_driver_sql("UPDATE scans SET resent = NULL")
    assert spicd("sweep", "--dry-run", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document == {"surveys": [], "scans": [idle], "folders": [], "removed": None}
    assert kept.scans.get(idle)
    assert spicd("sweep", "--dry-run") == 0
    assert idle in capsys.readouterr().out


def test_a_sweep_removes_it_and_says_so(kept: Catalog, capsys: pytest.CaptureFixture[str]) -> None:
    assert spicd("sweep", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["removed"] == {"surveys": 0, "scans": 1, "folders": 0}
    with pytest.raises(NotFound):
        kept.scans.get(document["scans"][0])
    assert spicd("sweep") == 0
    assert "nothing to sweep" in capsys.readouterr().out


def test_more_files_without_a_row_than_kills_leave_need_a_word_more(
    kept: Catalog, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [Path(kept.blobs._root or "") / f"scans/scan-{number}-x" for number in range(4)]
    for folder in folders:
        folder.mkdir()
        os.utime(folder, (0, 0))
    assert spicd("sweep") == 1
    assert "is it the right database?" in capsys.readouterr().err
    assert all(folder.is_dir() for folder in folders)
    assert spicd("sweep", "--force") == 0
    assert not any(folder.is_dir() for folder in folders)


def test_a_folder_without_a_database_is_named_and_stays_empty(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert spicd("sweep", "--data-dir", str(tmp_path)) == 1
    assert "no database" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
