"""What can go wrong in the pipeline, and the stable code of each.

PipelineError
├── ScanError                scan_unreadable        a file that is not a sound PLY, PCD, E57, LAS or LAZ
│   ├── ScanTooLarge         scan_too_large         more points than the limit
│   ├── ScanUnits            scan_units             an extent that says millimetres
│   └── ScanFarAway          scan_far_away          an origin many kilometres away
├── RegistrationFailed       registration_failed    no scan could be placed
├── MapFailed                map_failed             nothing to tile, no point left
├── TrainingFailed           training_failed        a map too small to train on, a loss that is no number
├── ProcessLost              process_lost           a process that shared the work ended without a word (often: no memory)
├── OutOfMemory          out_of_memory          the step would take more memory than it may
├── NoSpaceLeft              disk_full              the disk is full; the step can be run again
├── DetectorUnavailable      detector_unavailable   no such model, or its files do not match its card
└── Cancelled                cancelled              somebody dismissed the job, or another worker has the step
    └── GaveWay              cancelled              the step goes on later: others go first

DeviceLost is none of them: nobody's fault, and no end of the job. The process ends, and another runs the step.
"""

from __future__ import annotations

import re

_DEVICE_LOST = re.compile(r"CUDA (driver )?error(?!: (out of memory|CUBLAS_STATUS_ALLOC_FAILED))")


class PipelineError(Exception):
    """Base of every error that a user can cause and mend; `str()` is one sentence with the numbers."""

    code = "pipeline_error"


class ScanError(PipelineError):
    code = "scan_unreadable"


class ScanTooLarge(ScanError):
    code = "scan_too_large"


class ScanUnits(ScanError):
    code = "scan_units"


class ScanFarAway(ScanError):
    code = "scan_far_away"


class RegistrationFailed(PipelineError):
    code = "registration_failed"


class MapFailed(PipelineError):
    code = "map_failed"


class TrainingFailed(PipelineError):
    code = "training_failed"


class ProcessLost(PipelineError):
    code = "process_lost"


class OutOfMemory(PipelineError):
    code = "out_of_memory"


class DetectorUnavailable(PipelineError):
    code = "detector_unavailable"


class Cancelled(PipelineError):
    code = "cancelled"


class GaveWay(Cancelled):
    """Not an error: what was done is kept, and the step is run again."""


class NoSpaceLeft(PipelineError):
    code = "disk_full"


class DeviceLost(Exception):
    """The device that runs the networks cannot be used by this process any more, and can by another.

    After an illegal access, a failed assertion in a kernel or a fault of the hardware (Xid) each later CUDA call of the
    process fails (CUDA Runtime API, `cudaErrorIllegalAddress`: "the process must be terminated and relaunched").
    """

    @classmethod
    def is_told_by(cls, error: BaseException) -> bool:
        """Tell whether an error says so, as torch has it. A lack of the device's memory is none of these."""
        if not isinstance(error, RuntimeError):
            return isinstance(error, cls)
        by_torch = any(kind.__name__ == "AcceleratorError" for kind in type(error).__mro__)
        return bool(_DEVICE_LOST.search(str(error))) or (by_torch and "out of memory" not in str(error))
