"""What placing scans, in a new map or in one that is there, has to be told."""

from __future__ import annotations

from dataclasses import dataclass

from worker.pipeline.map_settings import MapSettings
from worker.pipeline.registration_settings import RegistrationSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class PlacingSettings:
    """The settings of two stages, and the reader's limit."""

    registration: RegistrationSettings
    mapping: MapSettings
    max_points: int  #: of one scan
