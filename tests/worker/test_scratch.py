"""Folders of steps: gone with the step, swept when its process was killed, and never while it works."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from tests.support.processes import until
from worker.scratch import scratch_folder, shared_temporary, sweep

HOLDER = """
import pathlib, sys, time
from worker.scratch import scratch_folder
with scratch_folder(pathlib.Path(sys.argv[1]), "job-1-register") as folder:
    (folder / "half").write_text("half")
    print(folder, flush=True)
    time.sleep(60)
"""


def test_a_folder_goes_with_its_step_and_takes_temporary_files_of_others(tmp_path: Path) -> None:
    before = tempfile.gettempdir()
    with scratch_folder(tmp_path / "scratch", "job-1-register") as folder:
        assert Path(tempfile.mkdtemp()).parent == folder
        assert os.environ["TMPDIR"] == str(folder)
    assert not folder.exists()
    assert tempfile.gettempdir() == before
    assert os.environ.get("TMPDIR") != str(folder)


def test_steps_that_run_at_a_time_share_a_folder_for_temporary_files(tmp_path: Path) -> None:
    before = tempfile.gettempdir()
    with shared_temporary(tmp_path, "inference-1") as shared:
        one, other = (scratch_folder(tmp_path, f"job-{number}-score") for number in (1, 2))
        first, second = one.__enter__(), other.__enter__()
        assert Path(tempfile.mkdtemp()).parent == shared
        one.__exit__(None, None, None)  # the step that began first ends first
        assert Path(tempfile.mkdtemp()).parent == shared
        assert second.exists()
        other.__exit__(None, None, None)
        assert Path(tempfile.mkdtemp()).parent == shared
        assert not first.exists()
    assert tempfile.gettempdir() == before
    assert list(tmp_path.iterdir()) == []


def test_a_folder_goes_with_a_step_that_raises(tmp_path: Path) -> None:
    with pytest.raises(KeyError), scratch_folder(tmp_path, "job-1-register"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_what_a_living_process_holds_is_not_swept_and_what_a_killed_one_held_is(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    folder = Path(process.stdout.readline().decode().strip())
    assert sweep(tmp_path) == 0
    assert (folder / "half").exists()
    process.send_signal(signal.SIGKILL)
    process.wait()
    until(lambda: sweep(tmp_path) == 1)
    assert not folder.exists()


def test_a_folder_without_a_lock_is_left_alone_while_it_may_be_in_the_making(tmp_path: Path) -> None:
    young, old = tmp_path / "young", tmp_path / "old"
    for folder in (young, old):
        folder.mkdir()
    os.utime(old, (time.time() - 61,) * 2)
    assert sweep(tmp_path) == 1
    assert young.exists()
    assert not old.exists()


def test_a_folder_that_is_not_there_holds_nothing(tmp_path: Path) -> None:
    assert sweep(tmp_path / "nowhere") == 0


def test_a_folder_that_a_sweep_took_in_the_making_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, sweeps = fcntl.flock, iter([True, False])

    def flock(lock: int, how: int) -> None:
        if how == fcntl.LOCK_EX and next(sweeps):
            sweep(tmp_path)
        real(lock, how)

    monkeypatch.setattr("worker.scratch.fcntl.flock", flock)
    with scratch_folder(tmp_path, "job-1-register") as folder:
        assert folder.is_dir()
        (folder / "half").write_text("half")
