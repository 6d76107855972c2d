"""The programs of docs/client.md run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.flaky import CLOUD, Flaky, flaky_service
from tests.test_imports import ROOT

PROGRAMS = re.findall(r"^```py\n(.*?)^```", (ROOT / "docs/client.md").read_text(), re.MULTILINE | re.DOTALL)
ADDRESS = "http://127.0.0.1:8000"


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Flaky, Path]:
    monkeypatch.chdir(tmp_path)
    for name in ("monday", "tuesday"):
        (tmp_path / f"{name}.pcd").write_bytes(b"# .PCD v.7 of " + name.encode())
    return Flaky(steady=True), tmp_path


def run(program: str, flaky: Flaky) -> None:
    assert ADDRESS in program
    with flaky_service(flaky) as url:
        exec(program.replace(ADDRESS, url), {"__name__": "program"})


def test_the_page_has_the_programs_that_are_run_here() -> None:
    assert [re.findall("AsyncClient|Client|events", program)[0] for program in PROGRAMS] == [
        "Client",
        "AsyncClient",
        "Client",
    ]


@pytest.mark.parametrize("program", PROGRAMS[:2], ids=["sync", "async"])
def test_the_quick_start_compares_two_scans(
    service: tuple[Flaky, Path], capsys: pytest.CaptureFixture[str], program: str
) -> None:
    flaky, _ = service
    run(program, flaky)
    assert sorted(kind for kind, _ in flaky.made) == ["map", "scan", "scan", "survey"]
    assert "tile_007_003_002" in capsys.readouterr().out


def test_the_quick_start_downloads_the_cloud(service: tuple[Flaky, Path]) -> None:
    flaky, folder = service
    run(PROGRAMS[0], flaky)
    assert (folder / "changes.ply").read_bytes() == CLOUD


def test_the_dashboard_follows(service: tuple[Flaky, Path], capsys: pytest.CaptureFixture[str]) -> None:
    run(PROGRAMS[2], service[0])
    assert capsys.readouterr().out.split() == [
        *(f"change-{number}" for number in range(4)),
        "event-64",
        "survey.ready",
    ]
