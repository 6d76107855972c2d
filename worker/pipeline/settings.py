"""The settings of the whole method, one class a stage."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from worker.cloud.tiling import TilingSettings
from worker.detectors.card import Preprocessing
from worker.pipeline.mapping.settings import MapSettings, MultiScanSettings
from worker.pipeline.registration.settings import RegistrationSettings


class PipelineSettings(BaseModel):
    """One settings class a stage."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    registration: RegistrationSettings = Field(default_factory=RegistrationSettings)
    mapping: MapSettings = Field(default_factory=MapSettings)
    tiling: TilingSettings = Field(default_factory=TilingSettings)
    max_scan_points: int = Field(50_000_000, gt=0)

    def for_model(self, needs: Preprocessing) -> PipelineSettings:
        """Return the same settings with what is tied to a model's weights put in its place."""
        voxels = {"voxel_size": needs.voxel_size}
        tiles = {"tile_size": needs.tile_size, "min_points": needs.min_points}
        return self.model_copy(
            update={
                "registration": self.registration.model_copy(update=voxels),
                "tiling": self.tiling.model_copy(update=tiles),
            }
        )

    @property
    def multi_scan(self) -> MultiScanSettings:
        """What the registration of several scans needs of these."""
        return MultiScanSettings(
            registration=self.registration, mapping=self.mapping, max_points=self.max_scan_points
        )
