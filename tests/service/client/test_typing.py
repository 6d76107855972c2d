"""The client is typed: a program that uses it is checked, and what is wrong in it is found."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_imports import ROOT

SAMPLE = Path(__file__).with_name("typed_sample.py")


@pytest.mark.slow
def test_mypy_strict_finds_the_errors_of_a_program_and_no_others(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(SAMPLE.read_text())
    words = ("--strict", "--no-error-summary", "--config-file=", "--cache-dir", str(tmp_path / "cache"))
    command = [sys.executable, "-m", "mypy", *words, "--follow-imports=silent", str(program)]
    ended = subprocess.run(
        command, cwd=tmp_path, env={"MYPYPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert ended.stdout + ended.stderr == ""
    assert ended.returncode == 0


def test_the_package_says_that_it_is_typed() -> None:
    assert (ROOT / "service" / "py.typed").exists()
