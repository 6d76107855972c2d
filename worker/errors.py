"""What can go wrong in the pipeline, and the stable code of each.

PipelineError
├── ScanError                scan_unreadable        a file that is not a sound PLY or PCD
│   ├── ScanTooLarge         scan_too_large         more points than the limit
│   └── ScanUnits            scan_units             an extent that says millimetres
├── RegistrationFailed       registration_failed    no scan could be placed
├── MapFailed                map_failed             nothing to tile, no point left
├── TrainingFailed           training_failed        a map too small to train on, a loss that is no number
├── ProcessLost              process_lost           a process that shared the work ended without a word
├── DetectorUnavailable      detector_unavailable   no such model, or its files do not match its card
└── Cancelled                cancelled              somebody dismissed the job
"""

from __future__ import annotations


class PipelineError(Exception):
    """Base of every error that a user can cause and mend; `str()` is one sentence with the numbers."""

    code = "pipeline_error"


class ScanError(PipelineError):
    """The file named in the message cannot be read as a scan."""

    code = "scan_unreadable"


class ScanTooLarge(ScanError):
    """The file declares more points than the limit."""

    code = "scan_too_large"


class ScanUnits(ScanError):
    """The cloud is not in metres."""

    code = "scan_units"


class RegistrationFailed(PipelineError):
    """No scan could be registered well enough to be compared."""

    code = "registration_failed"


class MapFailed(PipelineError):
    """The scans do not make a map that can be tiled."""

    code = "map_failed"


class TrainingFailed(PipelineError):
    """The map cannot be trained on, or the training went astray."""

    code = "training_failed"


class ProcessLost(PipelineError):
    """A process that shared the work ended without a word; most often the machine had no memory left."""

    code = "process_lost"


class DetectorUnavailable(PipelineError):
    """No such model, or its files do not match its card."""

    code = "detector_unavailable"


class Cancelled(PipelineError):
    """The job was dismissed while it ran."""

    code = "cancelled"
