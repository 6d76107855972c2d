"""The audit of `make check`: it fails for a weakness, and for nothing else."""

from __future__ import annotations

import importlib.util
import json
import subprocess
from types import ModuleType
from typing import Any

import pytest

from tests.test_imports import ROOT

KNOWN = {"name": "fastapi", "version": "0.1", "vulns": []}
WEAK = {**KNOWN, "vulns": [{"id": "CVE-1", "fix_versions": ["0.2"]}]}
UNKNOWN = {"name": "fastapi", "skip_reason": "not found"}


@pytest.fixture
def audit() -> ModuleType:
    spec = importlib.util.spec_from_file_location("audit", ROOT / ".ci/audit.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("said", "status", "line"),
    [
        (json.dumps({"dependencies": [KNOWN, UNKNOWN]}), 0, "no known weakness in 1 of 2 packages"),
        (json.dumps({"dependencies": [KNOWN, WEAK]}), 1, "fastapi 0.1: CVE-1, mended in 0.2"),
        (json.dumps({"dependencies": [UNKNOWN]}), 0, "audit skipped: its source knows none of the packages"),
        ("", 0, "audit skipped: its source cannot be reached"),
    ],
)
def test_it_fails_for_a_weakness_alone_and_says_so_in_a_line(
    audit: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    said: str,
    status: int,
    line: str,
) -> None:
    monkeypatch.setattr(audit.subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], 1, said))
    assert audit.main() == status
    assert capsys.readouterr().out.strip().endswith(line)


def test_a_source_that_does_not_answer_is_not_waited_for(
    audit: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def slow(*_: object, timeout: float, **__: object) -> Any:
        raise subprocess.TimeoutExpired("pip_audit", timeout)

    monkeypatch.setattr(audit.subprocess, "run", slow)
    assert audit.main() == 0
    assert capsys.readouterr().out == "audit skipped: no answer within 20 s\n"
