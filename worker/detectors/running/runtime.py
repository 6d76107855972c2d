"""How a process runs networks; a detector that has one is told when it is opened."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

from worker.detectors.precision import Precision, PrecisionChoice
from worker.detectors.running.calls import Batches, DirectBatches


@dataclass(frozen=True, kw_only=True, slots=True)
class Runtime:
    """What a detector runs its network by: exactly, and in the thread that asks, where nobody says otherwise."""

    batches: Batches = field(default_factory=DirectBatches)
    precision: PrecisionChoice = "float32"
    at_once: bool | None = None  #: whether a batch is computed as one, as a GPU does best; None: on a GPU


@runtime_checkable
class RunsNetwork(Protocol):
    """A detector with a network."""

    precisions: ClassVar[tuple[Precision, ...]]  #: that the network can be computed in

    def run_with(self, runtime: Runtime) -> None:
        """Run it so from now on. Raises DetectorUnavailable for a precision that the device does not have."""
