"""What of the input is tied to SPICD-Net's weights."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class SpicdNetSettings(BaseModel):
    """`detector_settings` of a card of this detector."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    patch_points: int = Field(gt=0, description="points of a patch after FPS and repetition")
    chamfer_points: int | None = Field(
        default=128,
        gt=0,
        description="of each patch, that are compared; null: all, where the paper takes 128",
    )
    seed: int = Field(description="of FPS and of the Chamfer sample")

    @model_validator(mode="after")
    def _sample_fits(self) -> Self:
        if self.chamfer_points is not None and self.patch_points < self.chamfer_points:
            raise ValueError(
                f"the Chamfer sample takes {self.chamfer_points} of a patch's {self.patch_points} points "
                "without replacement"
            )
        return self
