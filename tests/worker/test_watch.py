"""Whether a step's processes go on, told of real ones."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator

import pytest

from tests.support.processes import until
from worker.watch import STOPPED_S, Watch, process_state

BUSY = "while :; do :; done"


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def group() -> Iterator[subprocess.Popen[bytes]]:
    """A shell that works, in a process group of its own."""
    process = subprocess.Popen(["/bin/sh", "-c", BUSY], start_new_session=True)
    yield process
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def state(pid: int) -> str:
    found = process_state(pid)
    return found.state if found else ""


def test_a_step_that_works_is_in_no_trouble(group: subprocess.Popen[bytes], clock: Clock) -> None:
    watch = Watch(group.pid, idle_s=10, clock=clock)
    first = process_state(group.pid)
    assert first is not None
    assert watch.trouble() is None
    until(lambda: (now := process_state(group.pid)) is not None and now.ticks > first.ticks + 5)
    clock.now = 9.0
    assert watch.trouble() is None
    clock.now = 18.0  # it has worked since it was first looked at
    assert watch.trouble() is None


def test_a_step_that_is_stopped_is_told_so_after_a_while_and_not_once_it_goes_on(
    group: subprocess.Popen[bytes], clock: Clock
) -> None:
    watch = Watch(group.pid, clock=clock)
    os.kill(group.pid, signal.SIGSTOP)
    until(lambda: state(group.pid) == "T")
    assert watch.trouble() is None
    clock.now = STOPPED_S
    assert watch.trouble() == ("was stopped from outside and did not go on", True)
    os.kill(group.pid, signal.SIGCONT)
    until(lambda: state(group.pid) != "T")
    assert watch.trouble() is None


def test_a_step_that_uses_no_processor_for_long_is_told_so(clock: Clock) -> None:
    with subprocess.Popen(["/bin/sleep", "60"], start_new_session=True) as process:
        until(lambda: state(process.pid) == "S")
        watch = Watch(process.pid, idle_s=100, clock=clock)
        assert watch.trouble() is None
        for clock.now in (25.0, 50.0, 75.0, 99.0):
            assert watch.trouble() is None
        clock.now = 100.0
        assert watch.trouble() == ("did nothing for 100 s", False)
        process.kill()


def test_of_a_process_that_is_gone_nothing_is_said(clock: Clock) -> None:
    process = subprocess.Popen(["/bin/true"], start_new_session=True)
    process.wait()
    assert process_state(process.pid) is None
    assert Watch(process.pid, clock=clock).trouble() is None


def test_a_step_is_not_blamed_for_a_machine_that_stood_still(clock: Clock) -> None:
    with subprocess.Popen(["/bin/sleep", "60"], start_new_session=True) as process:
        until(lambda: state(process.pid) == "S")
        watch = Watch(process.pid, idle_s=100, clock=clock)
        assert watch.trouble() is None
        clock.now = 5000.0
        assert watch.trouble() is None
        process.kill()
