"""Seconds by stage, read off the reports that a piece of work makes about itself."""

from __future__ import annotations

import resource
import time

from worker.progress import Progress


def processor_seconds() -> float:
    """Of this process and of the children that have ended: what others do on the machine does not count."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


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
        """By stage in the order of their first reports, and in `total`; time goes on until this is asked."""
        self._count()
        return {**self._seconds, "total": self._last - self._begun}

    def _count(self) -> None:
        now = time.perf_counter()
        self._seconds[self._stage] = self._seconds.get(self._stage, 0.0) + now - self._last
        self._last = now
