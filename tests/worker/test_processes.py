"""What runs in other processes is Python's own `eval`, `sqrt` and `sleep`: a new process has to find it by name."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from worker.errors import PipelineError, ProcessLost
from worker.processes import default_processes, open_processes

WHO = "__import__('os').getpid()"


@pytest.mark.parametrize("count", [0, 1, 2])
def test_every_task_gives_its_result_whatever_the_number_of_processes(count: int) -> None:
    with open_processes(count) as processes:
        assert sorted(processes.map_unordered(math.sqrt, [9.0, 4.0, 1.0, 16.0])) == [1.0, 2.0, 3.0, 4.0]
        assert list(processes.map_unordered(math.sqrt, [])) == []
        assert list(processes.map_unordered(math.sqrt, [25.0])) == [5.0]  # and it goes on


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_processes_are_none_and_the_caller_does_the_work(count: int) -> None:
    with open_processes(count) as processes:
        assert list(processes.map_unordered(eval, [WHO])) == [os.getpid()]


def test_two_processes_are_others_than_the_caller_with_one_thread_each() -> None:
    asked = (
        WHO,
        "__import__('os').environ['OMP_NUM_THREADS']",
        "__import__('os').environ['OMP_WAIT_POLICY']",
        "__import__('worker.threads').threads.query_threads()",
    )
    with open_processes(2) as processes:
        who, *rest = (next(processes.map_unordered(eval, [each])) for each in asked)
    assert who != os.getpid()
    assert rest == ["1", "passive", 1]


@pytest.mark.parametrize("count", [1, 2])
def test_an_exception_of_a_task_comes_through(count: int) -> None:
    with (
        open_processes(count) as processes,
        pytest.raises(ValueError, match=r"math domain error|nonnegative"),
    ):
        list(processes.map_unordered(math.sqrt, [4.0, -1.0]))


def test_a_process_that_is_killed_is_told_as_lost_with_advice() -> None:
    with (
        open_processes(2) as processes,
        pytest.raises(ProcessLost, match=r"out of memory.*more memory") as error,
    ):
        list(processes.map_unordered(signal.raise_signal, [signal.SIGKILL]))
    assert isinstance(error.value, PipelineError)
    assert error.value.code == "process_lost"


def test_who_stops_listening_leaves_most_tasks_undone(tmp_path: Path) -> None:
    """A dismissal arrives between two results; what waits in the queue is not begun."""
    task = "(__import__('pathlib').Path({!r}).touch(), __import__('time').sleep(0.1))"
    with open_processes(2) as processes:
        results = processes.map_unordered(eval, [task.format(str(tmp_path / str(n))) for n in range(60)])
        next(results)
        results.close()  # type: ignore[attr-defined]
    assert 1 <= len(list(tmp_path.iterdir())) < 30


PARENT = """
import time
from worker.processes import open_processes

if __name__ == "__main__":
    with open_processes(2) as processes:
        print(*sorted(processes.map_unordered(eval, ["__import__('os').getpid()"] * 2)), flush=True)
        list(processes.map_unordered(time.sleep, [100, 100]))
"""


def test_processes_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    """They hold the other end of the pipe, which closes when the last of them is gone."""
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, env=environment, text=True
    ) as parent:
        assert parent.stdout is not None
        children = parent.stdout.readline().split()
        assert children
        time.sleep(0.2)  # they sleep in their tasks by now
        parent.kill()
        try:
            parent.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            for child in children:
                os.kill(int(child), signal.SIGKILL)
            pytest.fail(f"processes {children} outlive their parent")


def test_there_is_one_process_a_core_that_may_be_used() -> None:
    assert 1 <= default_processes() <= (os.cpu_count() or 1)
