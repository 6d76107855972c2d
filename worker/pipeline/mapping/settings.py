"""How many scans become one map: which pairs are registered, and what counts as a contradiction."""

from __future__ import annotations

from dataclasses import dataclass, field

from pydantic import Field

from worker.cloud.settings import StrictModel
from worker.pipeline.placement.settings import PlacementSettings
from worker.pipeline.registration.settings import RegistrationSettings


class MappingSettings(StrictModel):
    """Of overlap culling, the pose graph and the multi-view refinement (paper, Section 3.3.2, and what we add)."""

    min_box_overlap: float = Field(
        0.2, ge=0, le=1, description="volume two bounding boxes share, of the smaller one"
    )
    max_centroid_distance: float = Field(10.0, gt=0, description="metres")
    max_height_difference: float = Field(1.5, gt=0, description="metres between the centroids, along z")
    partners: int = Field(4, ge=1, description="pairs that a scan proposes, the likeliest first")
    searched_partners: int = Field(6, ge=1, description="the same where a pair had to be searched")
    partners_across: int = Field(3, ge=1, description="the same between components that are not joined yet")
    pairing_rounds: int = Field(
        3, ge=1, description="of registering pairs, as long as they leave the scans in several components"
    )
    candidates: int = Field(6, ge=1, description="BEV candidates of a pair that has no start")
    loop_distance: float = Field(
        0.1, gt=0, description="metres a registration may be off those of the others around a loop"
    )
    loop_angle: float = Field(0.026, gt=0, description="radians, likewise (1.5 degrees)")
    max_contradiction: float = Field(
        0.01,
        gt=0,
        le=1,
        description="share of a scan in another's free space that puts the edges between in doubt",
    )
    refinement_rounds: int = Field(3, ge=0, description="of the multi-view refinement of all scans")


@dataclass(frozen=True, kw_only=True, slots=True)
class JointRegistrationSettings:
    """What the registration of many scans needs: the settings of two stages, and the reader's limit."""

    registration: RegistrationSettings
    mapping: MappingSettings
    max_points: int  #: of one scan
    placement: PlacementSettings = field(default_factory=lambda: PlacementSettings.model_validate({}))
