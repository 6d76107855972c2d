"""/models: what the model store holds."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from pydantic import Field

from service.api.documents import Document
from service.api.problems import documented
from service.api.requests import Request
from service.api.services import Provided

router = APIRouter(tags=["models"])

Part = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]


class ModelList(Document):
    """The cards, and the model that is used where a request names none."""

    models: list[dict[str, Any]]
    default: str = Field(examples=["spicd-net/1"])


class ModelRequest(Request):
    """Which version."""

    version: Annotated[Part | None, Field(description="left out: the newest")] = None


@router.get("/models", summary="List models")
def list_models(services: Provided) -> ModelList:
    """Every card: what a model is, how it was made and measured, and what it needs."""
    return ModelList(models=services.cards.all(), default=services.settings.model)


@router.get("/models/{name}", summary="Look at a model", responses=documented("not_found", "invalid_request"))
def get_model(
    services: Provided, name: Annotated[Part, Path()], asked: Annotated[ModelRequest, Query()]
) -> dict[str, Any]:
    """The card of a model."""
    return services.cards.of(name, asked.version)
