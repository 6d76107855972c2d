"""The method as a library: scans to a map, a survey of it, and what changed between the two."""

from worker.pipeline.flow import BuiltMap, LocatedSurvey, build_map, compare, detect, locate_survey
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.settings import PipelineSettings

__all__ = [
    "BuiltMap",
    "LocatedSurvey",
    "PipelineSettings",
    "ScanFile",
    "build_map",
    "compare",
    "detect",
    "locate_survey",
]
