"""What the catalog takes and gives: frozen values, the same for the API and for the workers."""

from __future__ import annotations

from datetime import UTC
from typing import Annotated, Any, Literal, Self

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

TERMINAL: frozenset[JobStatus] = frozenset({"successful", "failed", "dismissed"})


class Record(BaseModel):
    """Base of every record: frozen, strict about names, and free of NaN and infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Problem(Record):
    """Why a job failed, as data; api/problems.py turns it into RFC 9457."""

    code: str  #: stable, from the error trees of service/errors.py and worker/errors.py
    detail: str  #: one sentence with the numbers

    @classmethod
    def of(cls, error: BaseException) -> Self:
        """The problem of an error that carries a `code`; any other shows its type alone, for its text may tell too much."""
        code = getattr(error, "code", None)
        if isinstance(code, str):
            return cls(code=code, detail=str(error))
        return cls(
            code="internal",
            detail=f"the job stopped on an unexpected {type(error).__name__}; see the worker's log",
        )


class ScanRecord(Record):
    """One uploaded file, unread."""

    scan_id: str
    filename: str  #: as the client named it
    format: ScanFormat  #: by the first bytes of the file
    size: int  #: bytes
    sha256: str
    device_id: str | None
    captured_at: Utc | None
    pose: Matrix | None  #: map_from_sensor, the client's guess
    key: str  #: of the blob
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


class MapRecord(Record):
    """A reference map as it is in use: the newest of its versions that is ready, and the newest where none is."""

    map_id: str
    name: str | None
    version: int  #: the one that is shown here, as are the status and all that is about its building
    status: MapStatus
    model: str  #: `name/version`, whose card gives voxel and tile size
    settings: dict[str, Any]
    anchor: Anchor | None
    scans: tuple[ScanOutcome, ...]  #: in the order of the request
    bounds: Bounds | None  #: None until it is built
    counts: dict[str, int]  #: empty until it is built
    registration: (
        dict[str, Any] | None
    )  #: totals of the registration (paper, Table 2); None until it is built
    job_id: str
    problem: Problem | None
    created: Utc
    updated: Utc


class VersionRecord(Record):
    """One state of a map; a survey stays with the version that it was compared with."""

    map_id: str
    version: int  #: 1, 2, ...
    status: MapStatus
    base_version: int | None  #: the version that it goes on from; None in the first
    survey_id: str | None  #: the accepted survey that it takes over; None where it is made of scans
    model: str  #: the map's
    settings: dict[str, Any]  #: the map's
    scans: tuple[ScanOutcome, ...]  #: those of the base that were accepted, then the new ones
    bounds: Bounds | None
    counts: dict[str, int]
    registration: dict[str, Any] | None
    job_id: str  #: of the job that builds it, and so of its files (`keys.map_folder`)
    problem: Problem | None
    created: Utc
    updated: Utc


class SurveyRecord(Record):
    """A later visit compared with a map; `counts` is empty until it is done."""

    survey_id: str
    map_id: str
    map_version: (
        int  #: the version that was in use when the survey was asked for, and that it is compared with
    )
    status: SurveyStatus
    model: str  #: `name/version`
    threshold: float | None  #: asked for, then the one that was used
    device_id: str | None
    captured_at: Utc  #: given, else the latest of its scans, else the time of the request
    scans: tuple[ScanOutcome, ...]  #: in the order of the request
    counts: dict[str, int]
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
    job_id: str  #: of the job that trains it, and so of its files (`keys.model_folder`)
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
    map_id: str
    survey_id: str | None
    model: str | None  #: `name/version` of the model that it trains
    status: JobStatus
    message: str  #: the stage
    progress: int = Field(ge=0, le=100)
    problem: Problem | None
    created: Utc
    started: Utc | None
    finished: Utc | None
    updated: Utc


class ChangeRecord(Record):
    """A tile of a survey with what a client needs beside it."""

    tile: TileRecord
    map_id: str
    map_version: int
    survey_id: str
    model: str
    threshold: float | None
    captured_at: Utc
