"""How a process runs networks; a detector that has one is told when it is opened."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from worker.detectors.precision import PrecisionChoice
from worker.detectors.running.calls import Batches, DirectBatches


@dataclass(frozen=True, kw_only=True, slots=True)
class Runtime:
    """What a detector runs its network by: exactly, and in the thread that asks, where nobody says otherwise."""

    batches: Batches = field(default_factory=DirectBatches)
    precision: PrecisionChoice = "float32"


@runtime_checkable
class RunsNetwork(Protocol):
    """A detector with a network."""

    def run_with(self, runtime: Runtime) -> None:
        """Run it so from now on. Raises DetectorUnavailable for a precision that the device does not have."""
