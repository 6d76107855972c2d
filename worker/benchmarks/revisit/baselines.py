"""What users would take instead, as methods of this benchmark."""

from __future__ import annotations

from worker.benchmarks.baselines import Baseline, CloudToCloud, M3c2, M3c2Approximation, m3c2_is_installed
from worker.benchmarks.revisit.methods import Method


def baseline_methods() -> tuple[Method, ...]:
    """Those that this machine can run: the real M3C2 needs a library that is an extra of the install."""
    found: list[Baseline] = [
        CloudToCloud(statistic="mean"),
        CloudToCloud(statistic="far"),
        M3c2Approximation(),
    ]
    if m3c2_is_installed():
        found.append(M3c2())
    return tuple(Method(name=baseline.name, score=baseline.score) for baseline in found)
