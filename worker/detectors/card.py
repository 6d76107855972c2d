"""The card of a model: what it is, how it was made and measured, and what it needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

#: The models that come with the code, wherever a command is typed.
MODEL_STORE = Path(__file__).resolve().parents[2] / "model_store"


class Preprocessing(BaseModel):
    """What is tied to the weights, and so comes from the card and never from a default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    voxel_size: float = Field(gt=0, description="metres; both maps are fused at this size")
    tile_size: tuple[float, float, float] = Field(description="metres")
    patch_points: int = Field(gt=0, description="points of a patch after FPS and repetition")
    min_points: int = Field(gt=0, description="tiles with fewer points are not scored")
    chamfer_points: int | None = Field(
        default=128,
        gt=0,
        description="of each patch, that are compared; null: all, where the paper takes 128",
    )
    seed: int = Field(description="of FPS and of the Chamfer sample")


class Card(BaseModel):
    """`model_store/<name>/<version>/card.json`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    version: str
    detector: str = Field(description="key in worker.detectors.store.DETECTORS")
    summary: str
    classes: tuple[str, str, str] = ("unchanged", "changed", "different place")
    threshold: float = Field(
        ge=0, le=1, description="a tile is changed above this score, the probability that it is not as it was"
    )
    preprocessing: Preprocessing
    weights: str | None = Field(default=None, description="file beside the card")
    sha256: str | None = Field(default=None, description="of the weights file")
    training: dict[str, Any] = Field(default_factory=dict, description="how it was made, with the command")
    evaluation: dict[str, Any] = Field(default_factory=dict, description="what it reaches, with the command")
    licence: str = ""
    sources: tuple[str, ...] = ()
