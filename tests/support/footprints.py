"""What the processes of a service take: memory, open files, threads, by Linux's /proc."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tests.support.processes import descendants


@dataclass(frozen=True)
class Footprint:
    """What one process takes, or several of one name together."""

    resident: int  #: bytes
    files: int  #: open descriptors
    threads: int
    processes: int = 1

    def __add__(self, other: Footprint) -> Footprint:
        return Footprint(
            self.resident + other.resident,
            self.files + other.files,
            self.threads + other.threads,
            self.processes + other.processes,
        )


def footprints(pid: int) -> dict[str, Footprint]:
    """Return what a service and all that it started take, by what each is."""
    found: dict[str, Footprint] = {}
    for each in (pid, *descendants(pid)):
        with suppress(OSError, IndexError):  # it ended meanwhile
            name, taken = _name(each), _footprint(each)
            found[name] = found[name] + taken if name in found else taken
    return found


def peak_resident() -> int:
    """Return the most bytes that this process has held in memory.

    `ru_maxrss` of getrusage(2) is not that: what Python starts with vfork carries the peak of its parent over exec.
    """
    return 1024 * _number("VmHWM", Path("/proc/self/status").read_text())


def _footprint(pid: int) -> Footprint:
    status = Path(f"/proc/{pid}/status").read_text()
    return Footprint(
        resident=1024 * _number("VmRSS", status),
        files=len(os.listdir(f"/proc/{pid}/fd")),  # noqa: PTH208 - names alone
        threads=_number("Threads", status),
    )


def _number(key: str, status: str) -> int:
    match = re.search(rf"^{key}:\s+(\d+)", status, re.MULTILINE)
    return int(match.group(1)) if match else 0


def _name(pid: int) -> str:
    """Say what a process is by its command line; a fork of a worker has its worker's."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode("latin-1").rstrip("\0").split("\0")
    if "worker" in words:
        kind = words[words.index("worker") + 1]
        parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]
        above = Path(f"/proc/{parent}/cmdline").read_bytes().decode("latin-1").split("\0")
        return f"step of {kind}" if "worker" in above else f"{kind} worker"
    if "service" in words:
        return "API and launcher" if "up" in words else " ".join(words[words.index("service") :][:2])
    if "multiprocessing" in " ".join(words):
        return "process of a pool"
    return Path(words[0].split()[0]).name.rstrip(":")


@contextmanager
def watched(pid: int, *, every_s: float = 1.0) -> Iterator[dict[str, int]]:
    """Give the most that processes of each name took together, in bytes, as it grows while the block runs."""
    most: dict[str, int] = {}
    over = threading.Event()

    def watch() -> None:
        while not over.wait(every_s):
            for name, taken in footprints(pid).items():
                most[name] = max(most.get(name, 0), taken.resident)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield most
    finally:
        over.set()
        thread.join()
