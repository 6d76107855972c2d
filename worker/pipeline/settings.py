"""The settings of the whole method, one class a stage."""

from __future__ import annotations

from pydantic import Field

from worker.cloud.carrier import CarrierSettings
from worker.cloud.fusing import MEMORY_BYTES
from worker.cloud.settings import StrictModel
from worker.cloud.tiling import TilingSettings
from worker.detectors.card import Preprocessing
from worker.pipeline.mapping.settings import JointRegistrationSettings, MappingSettings
from worker.pipeline.placement.settings import PlacementSettings
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.results.objects import ObjectSettings


class PipelineSettings(StrictModel):
    """One settings class a stage."""

    carrier: CarrierSettings = CarrierSettings.model_validate({})
    registration: RegistrationSettings = Field(default_factory=RegistrationSettings)
    placement: PlacementSettings = PlacementSettings.model_validate({})
    mapping: MappingSettings = Field(default_factory=MappingSettings)
    tiling: TilingSettings = Field(default_factory=TilingSettings)
    objects: ObjectSettings = Field(default_factory=ObjectSettings)
    max_scan_points: int = Field(50_000_000, gt=0)
    memory_bytes: int = Field(
        MEMORY_BYTES,
        gt=0,
        description="about what fusing may take beside the fused cloud; the rest goes to the disk",
    )
    alarms_per_survey: float = Field(
        0.1, gt=0, description="false objects in a survey of a place without any change, in the mean"
    )

    def for_model(self, needs: Preprocessing) -> PipelineSettings:
        """Return the same settings with what is tied to a model's weights put in its place."""
        voxels = {"voxel_size": needs.voxel_size}
        tiles = {"tile_size": needs.tile_size, "min_points": needs.min_points, "tiles": needs.tiles}
        return self.with_values(
            registration=self.registration.with_values(**voxels), tiling=self.tiling.with_values(**tiles)
        )

    @property
    def joint_registration(self) -> JointRegistrationSettings:
        """What the registration of many scans needs of these."""
        return JointRegistrationSettings(
            registration=self.registration,
            mapping=self.mapping,
            max_points=self.max_scan_points,
            placement=self.placement,
        )
