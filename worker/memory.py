"""How much memory the process of a step may take, so that one file too many ends a step and not the machine.

Linux counts against `RLIMIT_DATA` what a process may write to and shares with nobody: what it allocated, not the files
that it mapped for reading, nor the address space that libraries reserve. Past the limit an allocation fails, which
Python raises as a MemoryError; without one the kernel kills the step, or something else on the machine.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from worker.errors import OutOfMemory

SHARE = 0.8  #: of the machine's memory, or of the container's, that a step may take where nothing is set

#: Where a container's limit stands: version 2 of the kernel's control groups, and version 1.
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
_FAILED = re.compile("not enough memory|can't allocate memory|bad_alloc|out of memory", re.IGNORECASE)


def limit_memory(most: int | None) -> int:
    """Limit what this process, and each that it starts, may allocate from now on; return the limit, 0 for none.

    `most` is in bytes, 0: no limit, None: `SHARE` of what there is. Each process has a limit of its own: those of a
    pool may take so much each. A limit that is stricter already stands. Does nothing where the system has none.
    """
    try:
        import resource  # noqa: PLC0415 - not on every system
    except ImportError:
        return 0
    wanted = int(SHARE * available_memory()) if most is None else most
    if not wanted:
        return 0
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        wanted = min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (wanted, hard))
    return wanted


def available_memory() -> int:
    """Return the bytes that the machine has, or the container where that is less."""
    sizes = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for path in _LIMITS:
        with suppress(OSError, ValueError):  # not there; "max"
            sizes.append(int(path.read_text()))
    return min(sizes)


@contextmanager
def as_out_of_memory(what: str) -> Iterator[None]:
    """Raise OutOfMemory for an allocation that failed within, whichever library tells of it."""
    try:
        yield
    except MemoryError:
        raise _told(what) from None
    except RuntimeError as error:  # as PyTorch has it
        if _FAILED.search(str(error)) is None:
            raise
        raise _told(what) from None


def _told(what: str) -> OutOfMemory:
    return OutOfMemory(
        f"{what} needs more memory than it may take; send fewer or smaller scans at once, "
        "or raise SPICD_STEP_MEMORY_BYTES"
    )
