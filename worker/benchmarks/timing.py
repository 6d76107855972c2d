"""What benchmarks measure time with: seconds by stage, processor seconds, and the machine that they ran on."""

from __future__ import annotations

import os
import platform
import resource
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from worker.progress import Progress


class StageClock:
    """A `Progress` that passes everything on and counts the time since the last report for the stage before."""

    def __init__(self, progress: Progress, *, prefix: str = "") -> None:
        self._progress = progress
        self._prefix = prefix
        self._stage = "reading"  # what comes before the first report
        self._begun = self._last = time.perf_counter()
        self._seconds: dict[str, float] = {}

    def __call__(self, stage: str, share: float) -> None:
        self._count()
        self._stage = stage
        self._progress(self._prefix + stage, share)

    def seconds(self) -> dict[str, float]:
        """Return them by stage in the order of first reports, and in `total`; time goes on until this is asked."""
        self._count()
        return {**self._seconds, "total": self._last - self._begun}

    def _count(self) -> None:
        now = time.perf_counter()
        self._seconds[self._stage] = self._seconds.get(self._stage, 0.0) + now - self._last
        self._last = now


def processor_seconds() -> float:
    """Return those of this process and of its ended children: what others do on the machine does not count."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def processor_name() -> str:
    """Return the processor's name as Linux has it, elsewhere what Python knows."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def machine(**more: Any) -> dict[str, Any]:
    """Describe the machine, JSON-ready; `more` is added, and counts where a name is in both."""
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **more,
    }
