from __future__ import annotations

import os
import subprocess
import sys

import pytest

from worker.threads import wait_passively


def test_threads_sleep_while_they_wait_unless_the_environment_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    wait_passively()
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    wait_passively()
    assert os.environ["OMP_WAIT_POLICY"] == "active"


def test_a_process_of_its_own_thread_gives_trees_and_libraries_one() -> None:
    code = (
        "import os; from worker.threads import one_thread, query_threads; before = query_threads(); one_thread(); "
        "print(before, query_threads(), os.environ['OMP_NUM_THREADS'], os.environ['OPENBLAS_NUM_THREADS'])"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert told.stdout.split() == ["2", "1", "1", "1"]


@pytest.mark.slow
@pytest.mark.parametrize("module", ["worker.cli.main", "worker.__main__"])
def test_neither_command_has_imported_torch_before_it_can_say_so(module: str) -> None:
    code = f"import sys, {module}; sys.exit(bool({{'torch', 'open3d'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
