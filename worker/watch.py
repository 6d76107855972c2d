"""How a process is doing, by Linux's /proc (proc(5)): whether it was stopped from outside, and whether it works.

Elsewhere than on Linux nothing is known, and time limits alone end what hangs.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

STOPPED_S = 2.0  #: a process that is stopped (SIGSTOP) for so long is taken for frozen
IDLE_S = 400.0  #: a step that used no processor time for so long hangs; no wait of its own may take so long
_PAUSED_S = 30.0  #: between two looks, which are a second apart where all is well


@dataclass(frozen=True, kw_only=True, slots=True)
class ProcessState:
    """What /proc/PID/stat says of a process."""

    state: str  #: R, S, D, T (stopped), Z (ended)
    group: int  #: process group
    ticks: int  #: of processor time, its own


def process_state(pid: int) -> ProcessState | None:
    """Return how a process is doing; None where it has gone, or the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (OSError, ValueError):
        return None
    return ProcessState(state=fields[0], group=int(fields[2]), ticks=int(fields[11]) + int(fields[12]))


def group_states(group: int) -> Iterator[ProcessState]:
    """Yield the state of each process of a group."""
    for entry in os.scandir("/proc") if Path("/proc/self/stat").exists() else ():
        if entry.name.isdecimal() and (state := process_state(int(entry.name))) and state.group == group:
            yield state


class Watch:
    """Watches a step's processes: a group that was stopped, or that does nothing, will not end by itself."""

    def __init__(
        self, group: int, *, idle_s: float = IDLE_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._group, self._idle_s, self._clock = group, idle_s, clock
        self._ticks = -1
        self._worked = self._ran = self._looked = clock()

    def trouble(self) -> tuple[str, bool] | None:
        """Return what is wrong, as the end of a sentence, and whether it came from outside; None while all is well."""
        states = list(group_states(self._group))
        if not states:
            return None
        now, ticks = self._clock(), sum(state.ticks for state in states)
        if now - self._looked > _PAUSED_S:  # nobody looked: the machine, or the container, stood still
            self._worked = self._ran = now
        self._looked = now
        if ticks != self._ticks:
            self._ticks, self._worked = ticks, now
        if not any(state.state in "Tt" for state in states):
            self._ran = now
        if now - self._ran >= STOPPED_S:
            return "was stopped from outside and did not go on", True
        if now - self._worked >= self._idle_s:
            return f"did nothing for {self._idle_s:.0f} s", False
        return None
