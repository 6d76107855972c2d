"""/models: what the model store holds, and what the site trained; /maps/{id}/models: a training."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from fastapi import Request as HttpRequest
from pydantic import Field

from service.api.http.answering.documents import Document, Link, Request, checked, link
from service.api.http.answering.problems import BODY, documented
from service.api.http.dependencies import Provided, Services
from service.api.http.guards.access import maps_of_key
from service.api.http.reading import bodies
from service.api.http.reading.fields import Id, Model
from service.api.http.reading.idempotency import KEYED, Keyed
from service.api.http.reading.submission import SUBMITTED, accepted, admit, job_headers, monitor, submit
from service.catalog.idempotency import Answer, Once
from service.catalog.models import name_for
from service.catalog.records import JobRecord, ModelRecord, ModelStatus
from service.errors import BadRequest, Conflict

router = APIRouter(tags=["models"])

Part = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]


class TrainingRequest(Request):
    """A model to train on a map, without any label."""

    name: Annotated[
        Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")] | None,
        Field(description="left out: the map's id and `-net`; versions are counted", examples=["lobby-net"]),
    ] = None
    base: Annotated[Model | None, Field(description="train this one further; left out: from nothing")] = None
    minutes: Annotated[
        float | None,
        Field(
            gt=0,
            description="of training, at most; left out: `SPICD_TRAINING_MINUTES`; no more than "
            "`SPICD_MAX_TRAINING_MINUTES`",
        ),
    ] = None
    epochs: Annotated[
        int | None, Field(ge=1, le=1000, description="at most; left out: as many as the minutes allow")
    ] = None


class ModelList(Document):
    """The cards, and the model that is used where a request names none."""

    models: list[dict[str, Any]]
    default: str = Field(examples=["voxel-net/1"])


class ModelRequest(Request):
    """Which version."""

    version: Annotated[Part | None, Field(description="left out: the newest")] = None


class AcceptedModel(Document):
    """A model that is going to be trained."""

    model: str = Field(description="as surveys name it once the job is done", examples=["lobby-net/1"])
    map_id: str = Field(examples=["lobby"])
    map_version: int = Field(description="that it is trained on", examples=[1])
    minutes: float = Field(description="of training, at most", examples=[10])
    job_id: str = Field(examples=["job-5f0c"])
    status: ModelStatus
    links: list[Link]


@router.post(
    "/maps/{map_id}/models",
    status_code=202,
    summary="Train a model on a map",
    responses=SUBMITTED
    | documented(
        *BODY, "not_found", "not_ready", "failed", "conflict", "queue_unavailable", "queue_full", *KEYED
    ),
    openapi_extra=bodies.documented(json=TrainingRequest),
)
async def train_model(
    request: HttpRequest,
    response: Response,
    services: Provided,
    map_id: Annotated[Id, Path()],
    keyed: Keyed,
) -> AcceptedModel:
    """From nothing, or from a model that is there (`base`); the changes to learn from are made, no label is needed.

    Its threshold is chosen on a part of the map that was kept out of training. Surveys then name the model.
    """

    def accept(record: ModelRecord, job: JobRecord) -> Answer:
        return accepted(request, _accepted(request, record, job), job)

    async with bodies.received(request, services, takes=(bodies.JSON,)) as body:
        wanted, once = checked(TrainingRequest, body.fields), keyed.once(body, accept)
    record, job = await services.writes.run(_create, services, map_id, wanted, maps_of_key(request), once)
    response.headers.update(job_headers(request, job))
    return _accepted(request, record, job)


@router.get("/models", summary="List models")
def list_models(request: HttpRequest, services: Provided) -> ModelList:
    """Every card: what a model is, how it was made and measured, and what it needs.

    A key that is bound to maps sees the released ones, and those that were trained on its maps.
    """
    return ModelList(models=services.cards.all(maps_of_key(request)), default=services.settings.model)


@router.get(
    "/models/{name}",
    summary="Look at a model",
    responses=documented("not_found", "not_ready", "failed", "invalid_request"),
)
def get_model(
    request: HttpRequest,
    services: Provided,
    name: Annotated[Part, Path()],
    asked: Annotated[ModelRequest, Query()],
) -> dict[str, Any]:
    """The card of a model."""
    return services.cards.of(name, asked.version, maps_of_key(request))


def _accepted(request: HttpRequest, record: ModelRecord, job: JobRecord) -> AcceptedModel:
    return AcceptedModel(
        model=record.model,
        map_id=record.map_id,
        map_version=record.map_version,
        minutes=record.minutes,
        job_id=job.job_id,
        status=record.status,
        links=[link(request, model_path(record.model), "self"), monitor(request, job)],
    )


def _create(
    services: Services, map_id: str, wanted: TrainingRequest, maps: Collection[str] | None, once: Once
) -> tuple[ModelRecord, JobRecord]:
    once.look()
    catalog, most = services.catalog, services.settings.most_training_minutes()
    minutes = min(services.settings.training_minutes, most) if wanted.minutes is None else wanted.minutes
    if minutes > most:
        raise BadRequest(f"a training of {minutes:g} minutes is asked for, at most {most:g} are given")
    catalog.maps.ready(map_id)
    name = wanted.name or name_for(map_id)
    if any(card.get("name") == name for card in services.cards.released()):
        raise Conflict(f"the name {name!r} is that of a model in the model store; choose another")
    admit(services, map_id)
    record, job = catalog.models.create(
        map_id,
        name=name,
        base=None if wanted.base is None else services.cards.check(wanted.base, maps),
        minutes=minutes,
        epochs=wanted.epochs,
        once=once,
    )
    submit(services, job, forget=lambda: catalog.models.take_back(job.job_id), once=once)
    return record, job


def model_path(model: str) -> str:
    """Return where the card of `name/version` is."""
    name, version = model.split("/")
    return f"/models/{name}?version={version}"
