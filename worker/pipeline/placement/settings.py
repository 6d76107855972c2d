"""Settings of placement: what it takes for a pose to be believed."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from worker.cloud.settings import StrictModel


class PlacementSettings(StrictModel):
    """Confidences are those of `belief`; docs/placement.md has the error curve that they lie on."""

    min_confidence: float = Field(
        0.7, gt=0, lt=1, description="of the survey's poses; below it no tile counts as unchanged"
    )
    min_scan_confidence: float = Field(
        0.1, gt=0, lt=1, description="of one scan's pose; below it the scan is left out as of another place"
    )
    min_rival_ratio: float = Field(
        7.0,
        ge=1,
        description="odds of the best pose over those of its rival; with less the scan is ambiguous",
    )
    max_prior_distance: float = Field(
        5.5, ge=0, description="metres; a prior that is off by more is not overcome, the scan is left out"
    )
    scale: Literal["warn", "refuse"] = Field(
        "warn", description="what becomes of a scan whose scale is off by more than `max_scale_error`"
    )
    max_scale_error: float = Field(
        0.006, gt=0, lt=1, description="of a scan against the map, that is not told"
    )
    refused_scale_error: float = Field(
        0.0125,
        gt=0,
        lt=1,
        description="of a scan against the map, from which on it is left out whatever `scale` says",
    )
    diagnosed: int = Field(
        3,
        ge=0,
        description="scans of a survey at most that a reason is looked for of why they found no place",
    )
    max_searches: int = Field(
        3, ge=0, description="global registrations that may be spent on such a reason, of one scan"
    )
