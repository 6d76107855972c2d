"""How a child process ends with its parent, on Linux also where the parent is killed with SIGKILL.

`prctl(PR_SET_PDEATHSIG)` (prctl(2)) names the signal that the kernel sends to a process when the thread that started
it ends. So children are started from a thread that lives as long as its process: the main one.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_POLL_S = 1.0

# Runs between fork and exec of a program that is not ours. A `preexec_fn` would run Python in a copy of a process
# with threads, which may deadlock; this is a fresh interpreter without site packages (about 15 ms).
_WRAPPER = """
import ctypes, os, signal, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() != int(sys.argv[1]):
        sys.exit(1)
os.execv(sys.argv[2], sys.argv[2:])
"""


def command_ending_with_parent(command: Sequence[str]) -> list[str]:
    """Return the same command, started so that it gets SIGTERM when the calling process ends (Linux only)."""
    return [sys.executable, "-I", "-S", "-c", _WRAPPER, str(os.getpid()), *command]


def end_with_parent(parent: int) -> None:
    """Have this process killed when `parent`, the id of the process that started it, ends.

    Elsewhere than on Linux a thread looks once a second.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    if os.getppid() != parent:  # it ended before the kernel knew
        os._exit(1)


def is_stopped(pid: int) -> bool:
    """Tell whether a process is stopped by a signal and does not go on; False where the system does not say (proc(5))."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):
        return False


def out_of_memory_kills() -> int:
    """Return how many processes the kernel has killed for want of memory, of this control group or the machine."""
    for path in (Path("/sys/fs/cgroup/memory.events"), Path("/proc/vmstat")):
        with suppress(OSError, ValueError):
            counts = dict(line.split() for line in path.read_text().splitlines())
            return int(counts.get("oom_kill", 0))
    return 0


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    os._exit(1)
