"""What clients send, as checked values; files travel beside them."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from service.api.values import DeviceId, Id, Instant, Model, Pose, Text, from_text, names_from_text
from service.catalog.records import Anchor

R = TypeVar("R", bound=BaseModel)


class Request(BaseModel):
    """Base of every request: a name that is not known is a mistake worth telling."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ScanQuery(Request):
    """What may be said of one scan beside its raw bytes; `ScanRequest` is the same, checked further."""

    filename: Annotated[
        str | None,
        Field(max_length=255, description="shown again, and names the file in errors", examples=["hall.pcd"]),
    ] = None
    captured_at: Annotated[Instant | None, Field(description="RFC 3339")] = None
    device_id: DeviceId | None = None
    pose: Annotated[str | None, Field(description="JSON: 4x4 row-major, map_from_sensor")] = None


class ScanRequest(Request):
    """What may be said of one scan."""

    filename: Annotated[Text | None, Field(max_length=255, examples=["hall.pcd"])] = None
    captured_at: Annotated[Instant | None, Field(description="RFC 3339")] = None
    device_id: DeviceId | None = None
    pose: Annotated[
        Pose | None, Field(description="4x4 row-major, map_from_sensor; a start for the registration")
    ] = None


class RegistrationRequest(Request):
    """Limits of the registration; what is left out keeps its default (paper, Table 1)."""

    max_correspondence_distance: Annotated[float | None, Field(gt=0, le=1, description="metres")] = None
    min_fitness: Annotated[float | None, Field(ge=0, le=1, description="inlier fraction")] = None
    max_inlier_rmse: Annotated[float | None, Field(gt=0, le=1, description="metres")] = None
    max_iterations: Annotated[int | None, Field(ge=1, le=1000, description="of ICP at each gate")] = None
    min_overlap: Annotated[
        float | None, Field(ge=0, le=1, description="share of the scan that the map covers")
    ] = None
    min_agreement: Annotated[
        float | None, Field(ge=0, le=1, description="share of the overlap on a common surface")
    ] = None


class MapSettings(Request):
    """What of a map can be set. Voxel and tile size belong to the model, and so to its card."""

    registration: RegistrationRequest = RegistrationRequest()


class AnchorRequest(Request):
    """Where a map lies on the Earth: the origin of its frame in WGS 84, and how the frame is turned; z points up there."""

    longitude: Annotated[float, Field(ge=-180, le=180, description="degrees, of the origin", examples=[13.4])]
    latitude: Annotated[float, Field(ge=-90, le=90, description="degrees, of the origin", examples=[52.5])]
    height: Annotated[
        float,
        Field(ge=-1000, le=10_000, description="metres above the ellipsoid, of the origin", examples=[76.2]),
    ]
    heading: Annotated[
        float,
        Field(
            ge=0,
            lt=360,
            description="degrees, clockwise from true north to the map's x axis; 90: x points east, y north",
            examples=[90],
        ),
    ]

    def anchor(self) -> Anchor:
        """As the catalog keeps it."""
        return Anchor(**self.model_dump())


class MapRequest(Request):
    """A map of scans that were uploaded before, or come with the request."""

    id: Annotated[Id | None, Field(description="left out: the service chooses one")] = None
    name: Annotated[Text | None, Field(max_length=200, examples=["Lobby, ground floor"])] = None
    scan_ids: Annotated[tuple[Id, ...], BeforeValidator(names_from_text), Field(max_length=1000)] = ()
    settings: Annotated[MapSettings, BeforeValidator(from_text)] = MapSettings()
    model: Annotated[Model | None, Field(description="left out: the service's default")] = None
    anchor: Annotated[
        Annotated[AnchorRequest, BeforeValidator(from_text)] | None,
        Field(description="left out: nobody knows where on the Earth it lies"),
    ] = None
    captured_at: Annotated[Instant | None, Field(description="of the files in this request")] = None
    device_id: Annotated[DeviceId | None, Field(description="of the files in this request")] = None


class VersionRequest(Request):
    """A version of a map: of further scans, or of a survey that was accepted."""

    scan_ids: Annotated[tuple[Id, ...], BeforeValidator(names_from_text), Field(max_length=1000)] = ()
    survey_id: Annotated[
        Id | None, Field(description="take over what this survey found changed; then without scans")
    ] = None
    captured_at: Annotated[Instant | None, Field(description="of the files in this request")] = None
    device_id: Annotated[DeviceId | None, Field(description="of the files in this request")] = None


class SurveyRequest(Request):
    """A visit to compare with a map, of scans that were uploaded before, or come with the request."""

    scan_ids: Annotated[tuple[Id, ...], BeforeValidator(names_from_text), Field(max_length=1000)] = ()
    captured_at: Annotated[Instant | None, Field(description="left out: the latest of its scans")] = None
    device_id: DeviceId | None = None
    model: Annotated[Model | None, Field(description="left out: the model of the map")] = None
    threshold: Annotated[
        float | None, Field(ge=0, le=1, description="probability of change; left out: the model's own")
    ] = None


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
            description="of training, at most; left out: `SPICD_TRAINING_MINUTES`; no more than `SPICD_MAX_TRAINING_MINUTES`",
        ),
    ] = None
    epochs: Annotated[
        int | None, Field(ge=1, le=1000, description="at most; left out: as many as the minutes allow")
    ] = None


def checked(kind: type[R], fields: dict[str, Any], *, place: str = "body") -> R:
    """The request in these fields. Raises RequestValidationError, which the API answers as FastAPI's own."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        errors = [
            {**entry, "loc": (place, *entry["loc"])}
            for entry in error.errors(include_url=False, include_context=False)
        ]
        raise RequestValidationError(errors) from error
