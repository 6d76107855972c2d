"""The shell of each step: load from the catalog, call the pipeline, save, report.

Every step takes the job's id alone and may run twice: it reads what the step before it left, and replaces what
an earlier run of itself left. A step of a job that has ended does nothing.
"""

from worker.jobs.maps import encode_map, register_map
from worker.jobs.surveys import export_survey, register_survey, score_survey
from worker.jobs.training import finish_model, pack_tiles, train_model

__all__ = [
    "encode_map",
    "export_survey",
    "finish_model",
    "pack_tiles",
    "register_map",
    "register_survey",
    "score_survey",
    "train_model",
]
