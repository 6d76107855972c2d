"""What the catalog takes and gives: frozen values, the same for the API and for the workers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, model_validator

from service.catalog.steps import JobKind

JobStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
MapStatus = Literal["building", "ready", "failed"]
ModelStatus = Literal["training", "ready", "failed"]
SurveyStatus = Literal["running", "ready", "failed"]
TileState = Literal["unchanged", "changed", "inconsistent", "unobserved"]
ScanFormat = Literal["ply", "pcd"]
Vector3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix = tuple[Row4, Row4, Row4, Row4]  #: (4, 4) row-major, rigid, target_from_source
Utc = Annotated[AwareDatetime, AfterValidator(lambda instant: instant.astimezone(UTC))]

Position = tuple[datetime, str]  #: where a page of a list ended: `created` and id of its last row

T = TypeVar("T")


def rfc3339(instant: datetime) -> str:
    """Write an instant as `2026-03-01T12:00:00.250000Z`; the fraction only where there is one."""
    return instant.astimezone(UTC).isoformat().replace("+00:00", "Z")


@dataclass(frozen=True, kw_only=True, slots=True)
class Page(Generic[T]):
    """Some rows of a longer list."""

    items: Sequence[T]
    more: bool  #: whether a further page has anything


class Record(BaseModel):
    """Base of every record: frozen, strict about names, and free of NaN and infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def of_row(cls, row: object) -> Self:
        """Return the record of a row of tables.py, whose attributes bear the same names."""
        return cls.model_validate(row, from_attributes=True)


class Problem(Record):
    """Why a job failed, as data; api/http/problems.py turns it into RFC 9457."""

    code: str  #: stable, from the error trees of service/errors.py and worker/errors.py
    detail: str  #: one sentence with the numbers

    @classmethod
    def of(cls, error: BaseException) -> Self:
        """Return the problem of an error that carries a `code`.

        Any other error shows its type alone, for its text may tell too much.
        """
        code = getattr(error, "code", None)
        if isinstance(code, str):
            return cls(code=code, detail=str(error))
        return cls(
            code="internal",
            detail=f"the job stopped on an unexpected {type(error).__name__}; see the worker's log",
        )


class ScanRecord(Record):
    """One uploaded file, unread."""

    scan_id: str = Field(examples=["scan-2b1f"])
    filename: str = Field(examples=["hall.pcd"])  #: as the client named it
    format: ScanFormat  #: by the first bytes of the file
    size: int = Field(description="bytes", examples=[1296000])
    sha256: str
    device_id: str | None
    captured_at: Utc | None
    pose: Matrix | None = Field(description="map_from_sensor as it was given, row-major")
    key: str = Field(exclude=True)  #: of the blob; clients do not see it
    created: Utc


class ScanOutcome(Record):
    """What became of one scan in a map or a survey; all but the id is None until registration has run."""

    scan_id: str
    accepted: bool | None = None
    fitness: float | None = None  #: inlier fraction, 0..1
    rmse: float | None = None  #: metres, over the inliers
    map_from_scan: Matrix | None = None
    translation_sigma: float | None = Field(
        None, description="metres, one sigma of where the scan stands, in the direction that is held worst"
    )
    rotation_sigma: float | None = Field(None, description="radians, likewise")
    path: tuple[str, ...] | None = Field(
        None,
        description="scan ids from the map's reference scan to this one, by the registrations that placed it; null in "
        "surveys and for scans that joined the map later",
    )
    reason: str | None = None  #: why it was left out


class Bounds(Record):
    """An axis-aligned box in the map frame, metres."""

    min: Vector3
    max: Vector3


class Anchor(Record):
    """Where a map lies on the Earth: its origin in WGS 84, and how it is turned. Its z axis points up there."""

    longitude: float = Field(ge=-180, le=180)  #: degrees, of the map frame's origin
    latitude: float = Field(ge=-90, le=90)  #: degrees
    height: float = Field(ge=-1000, le=10_000)  #: metres above the ellipsoid
    heading: float = Field(ge=0, lt=360)  #: degrees, clockwise from true north to the map's x axis


class TileRecord(Record):
    """The result of one tile of a survey."""

    tile_id: str  #: `tile_III_JJJ_KKK` (paper, Table A1)
    tile_index: tuple[int, int, int]
    bounds: Bounds
    state: TileState
    score: float | None = None  #: probability of change; None where the tile was not observed
    probabilities: Vector3 | None = None  #: unchanged, changed, different place
    n_reference: int  #: points of the reference in the tile
    n_current: int  #: points of the survey in the tile

    @model_validator(mode="after")
    def _scored_where_observed(self) -> Self:
        unscored = self.score is None or self.probabilities is None
        if unscored != (self.state == "unobserved"):
            raise ValueError(f"{self.tile_id}: a tile has a score exactly where it was observed")
        return self


class Built(Record):
    """What a map and a version of it have in common; a map shows its version in use."""

    map_id: str = Field(examples=["lobby"])
    version: int = Field(examples=[1])  #: 1, 2, ... of the map
    status: MapStatus
    model: str = Field(examples=["spicd-net/1"])  #: `name/version`, whose card gives voxel and tile size
    settings: dict[str, Any]
    scans: tuple[ScanOutcome, ...]  #: those of the base that were accepted, then the new ones, as requested
    bounds: Bounds | None = Field(description="metres, map frame")  #: None until it is built
    counts: dict[str, int] = Field(examples=[{"points": 181342, "tiles": 172, "scans": 25, "accepted": 24}])
    registration: dict[str, Any] | None = Field(
        description="totals of the registration of what is new in it (paper, Table 2); null until it is built",
        examples=[
            {"scans": 25, "accepted": 24, "pairs_possible": 300, "pairs_tried": 61, "pairs_accepted": 58}
        ],
    )
    job_id: str  #: of the job that builds it, and so of its files (`blob_keys.map_folder`)
    problem: Problem | None
    created: Utc
    updated: Utc


class MapRecord(Built):
    """A reference map as it is in use: the newest of its versions that is ready, and the newest where none is."""

    name: str | None
    anchor: Anchor | None = Field(description="where the map lies on the Earth; null: nobody said")


class VersionRecord(Built):
    """One state of a map; a survey stays with the version that it was compared with."""

    base_version: int | None = Field(description="the version it goes on from; null in the first")
    survey_id: str | None = Field(description="the survey it takes over; null where it is made of scans")


class SurveyRecord(Record):
    """A later visit compared with a map; `counts` is empty until it is done."""

    survey_id: str = Field(examples=["survey-91c4"])
    map_id: str = Field(examples=["lobby"])
    map_version: int = Field(description="of the map, that the survey is compared with", examples=[1])
    status: SurveyStatus
    model: str = Field(examples=["spicd-net/1"])
    threshold: float | None = Field(description="asked for, then the one that was used")
    device_id: str | None
    captured_at: Utc  #: given, else the latest of its scans, else the time of the request
    scans: tuple[ScanOutcome, ...]  #: in the order of the request
    counts: dict[str, int] = Field(
        examples=[{"tiles": 172, "unchanged": 150, "changed": 9, "inconsistent": 1, "unobserved": 12}]
    )
    job_id: str
    problem: Problem | None
    created: Utc
    updated: Utc


class ModelRecord(Record):
    """A model that is trained on a map, and is the site's own."""

    name: str
    version: int  #: 1, 2, ... of the name
    status: ModelStatus
    map_id: str
    map_version: int  #: what it is trained on
    base: str | None  #: the model that it goes on from; None: from nothing
    minutes: float  #: of the training, at most
    epochs: int | None  #: likewise; None: as many as the minutes allow
    card: dict[str, Any] | None  #: None until it is ready; `worker.detectors.card` says what is in it
    job_id: str  #: of the job that trains it, and so of its files (`blob_keys.model_folder`)
    created: Utc
    updated: Utc

    @property
    def model(self) -> str:
        """As requests name it."""
        return f"{self.name}/{self.version}"


class JobRecord(Record):
    """A job as clients see it."""

    job_id: str
    kind: JobKind
    status: JobStatus
    message: str = Field(description="the stage", examples=["registering"])
    progress: int = Field(ge=0, le=100, examples=[40])
    created: Utc
    started: Utc | None
    finished: Utc | None
    updated: Utc
    map_id: str
    survey_id: str | None
    model: str | None = Field(description="that a training makes", examples=[None])  #: `name/version`
    problem: Problem | None


class ChangeRecord(Record):
    """A tile of a survey with what a client needs beside it."""

    tile: TileRecord
    map_id: str
    map_version: int
    survey_id: str
    model: str
    threshold: float | None
    captured_at: Utc
