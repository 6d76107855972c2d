"""The card of a model: what it is, how it was made and measured, and what it needs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError, model_validator

from worker.cloud.settings import StrictModel
from worker.cloud.tiling import TileChoice

#: The models that come with the code, wherever a command is typed.
MODEL_STORE = Path(__file__).resolve().parents[2] / "model_store"

#: A score may move so far in bfloat16: scores are shown with two digits.
SCORES_HOLD = 0.01

#: What release 0.1 kept under `preprocessing` and only SPICD-Net needs.
_SPICD_NET_SETTINGS_OF_0_1 = ("patch_points", "chamfer_points", "seed")

S = TypeVar("S", bound=BaseModel)


class Preprocessing(StrictModel):
    """How a map is built for a model: tied to the weights, so it comes from the card and never from a default."""

    voxel_size: float = Field(gt=0, description="metres; both maps are fused at this size")
    tile_size: tuple[float, float, float] = Field(description="metres")
    min_points: int = Field(gt=0, description="dense tiles with fewer points are not scored")
    tiles: TileChoice = Field(
        "dense", description="the tiles that are scored; detectors by voxels take all touched"
    )


class QuietRecord(StrictModel):
    """What the model found where nothing had changed: the map's own calibration leans on it."""

    surveys: int = Field(
        gt=0, description="in which nothing had changed, of other buildings than it was trained on"
    )
    scores: tuple[float, ...] = Field(
        description="of the regions found in them all the same: expected voxels"
    )


class PrecisionCheck(StrictModel):
    """How far the scores move where the network's large products are computed in bfloat16."""

    largest_score_difference: float = Field(ge=0, description="of all tiles, the probability of change")
    decided_otherwise: int = Field(
        ge=0, description="tiles that are on the other side of the card's threshold"
    )
    tiles: int = Field(gt=0, description="that were scored both ways")
    sha256: str = Field(description="of the weights")
    device: str
    data: str
    command: str

    @property
    def holds(self) -> bool:
        """Whether the scores are the same for all that is made of them."""
        return self.largest_score_difference <= SCORES_HOLD and not self.decided_otherwise


class BaseRecord(StrictModel):
    """The model whose weights are taken where a model's own file has none."""

    model: str = Field(description="name/version, in the same store")
    sha256: str = Field(description="of its weights file")


class Card(StrictModel):
    """`model_store/<name>/<version>/card.json`."""

    name: str
    version: str
    detector: str = Field(description="key in worker.detectors.registry.DETECTORS")
    summary: str
    classes: tuple[str, str, str] = ("unchanged", "changed", "different place")
    threshold: float = Field(
        ge=0, le=1, description="a tile is changed above this score, the probability that it is not as it was"
    )
    preprocessing: Preprocessing
    detector_settings: dict[str, Any] = Field(
        default_factory=dict, description="the detector's own; it validates them when it is loaded"
    )
    quiet: QuietRecord | None = Field(default=None, description="of models that score voxels")
    precision: dict[str, PrecisionCheck] = Field(
        default_factory=dict,
        description="what `spicd-worker evaluate precision`, or the training that published the model, measured, "
        "by `cpu` and `cuda`, which compute differently",
    )
    weights: str | None = Field(default=None, description="file beside the card")
    sha256: str | None = Field(default=None, description="of the weights file")
    base: BaseRecord | None = Field(
        default=None, description="of a model of which a part alone was trained: where the rest of it lies"
    )
    training: dict[str, Any] = Field(default_factory=dict, description="how it was made, with the command")
    evaluation: dict[str, Any] = Field(default_factory=dict, description="what it reaches, with the command")
    licence: str = ""
    sources: tuple[str, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _of_0_1(cls, card: Any) -> Any:
        """Move the settings of SPICD-Net to their place in a card that release 0.1 wrote."""
        if not isinstance(card, dict) or not isinstance(card.get("preprocessing"), dict):
            return card
        preprocessing = dict(card["preprocessing"])
        moved = {
            name: preprocessing.pop(name) for name in _SPICD_NET_SETTINGS_OF_0_1 if name in preprocessing
        }
        if not moved:
            return card
        settings = {**moved, **card.get("detector_settings", {})}
        return {**card, "preprocessing": preprocessing, "detector_settings": settings}

    @property
    def model(self) -> str:
        """The model's name, `name/version`."""
        return f"{self.name}/{self.version}"

    @property
    def fingerprint(self) -> str:
        """What tells two models of one name apart: the sha256 of the weights, or else of the detector's settings."""
        if self.sha256 is not None:
            return self.sha256
        return hashlib.sha256(json.dumps(self.detector_settings, sort_keys=True).encode()).hexdigest()

    def holds_in_bfloat16(self, kind: str) -> bool:
        """Tell whether these very weights were measured in bfloat16 as a `cpu` or `cuda` computes, and scores hold."""
        check = self.precision.get(kind)
        return check is not None and check.holds and check.sha256 == self.sha256

    def settings_as(self, kind: type[S]) -> S:
        """Read the detector's own settings. Raises ValueError, which names each unsound field."""
        try:
            return kind.model_validate(self.detector_settings)
        except ValidationError as unsound:
            reasons = (
                f"{'.'.join(['detector_settings', *map(str, error['loc'])])}: {error['msg']}"
                for error in unsound.errors()
            )
            raise ValueError("; ".join(reasons)) from unsound
