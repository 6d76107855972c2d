"""What the catalog takes and gives: frozen values, the same for the API and for the workers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    model_validator,
)

from service.catalog.steps import JobKind

JobStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
MapStatus = Literal["building", "ready", "failed"]
ModelStatus = Literal["training", "ready", "failed"]
SurveyStatus = Literal["running", "ready", "failed"]
TileState = Literal["unchanged", "changed", "inconsistent", "unobserved"]
ObjectKind = Literal["appeared", "disappeared", "moved"]
ObjectStatus = Literal["new", "still_there", "gone_again", "unknown", "accepted"]
PlacementState = Literal["confirmed", "in_doubt", "refused"]
#: Why a scan was left out, or what is odd about it; `worker/pipeline/registration/diagnosis.py` says what each means.
ScanReason = Literal[
    "unreadable",
    "damaged",
    "too_few_points",
    "degenerate",
    "too_little_overlap",
    "no_fit",
    "other_place",
    "ambiguous",
    "mirrored",
    "wrong_scale",
    "other_up_axis",
    "wrong_prior",
    "moved_while_scanning",
    "disagrees",
    "wrong_units",
    "far_from_origin",
    "far_points",
    "offset_taken_off",
    "no_sensor_place",
    "missing_returns",
    "odd_density",
    "odd_size",
    "little_coverage",
    "clock",
]
ScanFormat = Literal["ply", "pcd", "e57", "las", "laz"]
#: What an API key may do; `admin` is everything.
Scope = Literal["scans:write", "surveys:write", "maps:write", "changes:read", "admin"]
WebhookStatus = Literal["active", "disabled"]
DeliveryKind = Literal["event", "ping", "repeat"]
DeliveryStatus = Literal["pending", "delivered", "failed"]
#: What is told; docs/events.md says when, and what an event of each type carries.
EventType = Literal[
    "scan.uploaded",
    "scan.deleted",
    "job.ended",
    "map.deleted",
    "version.ready",
    "version.failed",
    "survey.ready",
    "survey.failed",
    "survey.deleted",
    "model.ready",
    "model.failed",
    "change.told",
    "change.updated",
    "change.withdrawn",
    "object.told",
    "object.updated",
    "object.gone_again",
    "object.seen_again",
    "object.accepted",
    "object.withdrawn",
]
Vector2 = tuple[float, float]
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

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        json_schema_serialization_defaults_required=True,  # documents have every member
    )

    @classmethod
    def of_row(cls, row: object) -> Self:
        """Return the record of a row of tables.py, whose attributes bear the same names."""
        return cls.model_validate(row, from_attributes=True)


def problem_urn(code: str) -> str:
    """Return the type of a problem with this code, as problem documents and events have it (RFC 9457)."""
    return f"urn:spicd:problem:{code}"


class Problem(Record):
    """Why a job failed, as data; api/http/answering/problems.py turns it into RFC 9457."""

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


class ScanWarning(Record):
    """What is odd about a scan or a survey that was taken."""

    reason: ScanReason = Field(examples=["wrong_scale"])
    detail: str = Field(description="a sentence for people; it may change")
    numbers: dict[str, float] = Field(
        default_factory=dict, description="metres, degrees, shares", examples=[{"scale": 1.012}]
    )


Warnings = Annotated[tuple[ScanWarning, ...], BeforeValidator(lambda given: given or ())]


class ScanRecord(Record):
    """One uploaded file, unread."""

    scan_id: str = Field(examples=["scan-2b1f"])
    filename: str = Field(examples=["hall.pcd"])  #: as the client named it
    format: ScanFormat  #: by the first bytes of the file
    size: int = Field(description="bytes", examples=[1296000])
    sha256: str
    device_id: str | None
    captured_at: Utc | None
    pose: Matrix | None = Field(
        description="map_from_sensor: from the sensor's axes, metres, to `frame`; row-major, whichever way it was given"
    )
    frame: str | None = Field(
        None, description="name of the frame that the pose leads to (REP 105)", examples=["map"]
    )
    key: str = Field(exclude=True)  #: of the blob; clients do not see it
    warnings: Warnings = Field(
        (), description="what is odd about it: of its clock at once, of its points once a job has read it"
    )
    created: Utc


class ScanOutcome(Record):
    """What became of one scan in a map or a survey; all but the id is None until registration has run.

    A scan that a release before the list of reasons left out has its `detail` alone.
    """

    scan_id: str
    pose: Matrix | None = Field(
        None,
        description="map_from_sensor that its registration starts from, row-major: as the request for this map or survey "
        "gave it, else as the upload had it then; null: none",
    )
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
    confidence: float | None = Field(
        None, ge=0, le=1, description="that it stands where it was taken; null where that was not asked"
    )
    reason: ScanReason | None = Field(None, description="why it was left out")
    detail: str | None = Field(
        None, description="the same in a sentence for people, with what to do; it may change"
    )
    numbers: dict[str, float] | None = Field(
        None,
        description="what the reason rests on: metres, degrees, shares; null where there is no reason",
        examples=[{"scale": 1.012}],
    )
    candidates: tuple[Matrix, ...] | None = Field(
        None, description="`ambiguous` alone: each map_from_scan that nothing tells from the others"
    )
    warnings: Warnings = Field((), description="what is odd about it beside, also where it was left out")


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
    observed_share: float | None = Field(None, ge=0, le=1)  #: of the tile, that the survey could judge
    appeared: int | None = Field(None, ge=0)  #: voxels; None of detectors without voxels
    disappeared: int | None = Field(None, ge=0)  #: likewise

    @model_validator(mode="after")
    def _scored_where_observed(self) -> Self:
        """Check that a tile has a score where it was observed; one that was judged in part may have one, too."""
        unscored = self.score is None or self.probabilities is None
        if unscored and self.state != "unobserved":
            raise ValueError(f"{self.tile_id}: a tile that was observed has a score")
        if not unscored and self.state == "unobserved" and self.observed_share is None:
            raise ValueError(f"{self.tile_id}: of tiles alone, one that was not observed has no score")
        return self


def _open_counter_clockwise(ring: tuple[Vector2, ...]) -> tuple[Vector2, ...]:
    """Return an outline without its first corner at its end, counter-clockwise. Raises ValueError for less than three."""
    corners = ring[:-1] if len(ring) > 1 and ring[0] == ring[-1] else ring
    if len(corners) < 3:
        raise ValueError(f"an outline has at least three corners, this one has {len(corners)}")
    following = (*corners[1:], corners[0])
    twice_area = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(corners, following, strict=True))
    return corners if twice_area >= 0 else corners[::-1]


class Place(Record):
    """Where a thing stands or stood: an upright box and what lies in it; map frame, metres, z up."""

    center: Vector3  #: of the box
    size: Vector3  #: along the axes of the box: two that lie level, then its height
    yaw: float  #: radians, counter-clockwise from the map's x axis to the first axis of the box
    footprint: Annotated[tuple[Vector2, ...], AfterValidator(_open_counter_clockwise)]
    #: x, y of the outline from above; taken closed or not and either way round, kept open and counter-clockwise
    height_over_floor: float | None  #: of the lower side; None: no floor was seen
    volume: float = Field(ge=0)  #: cubic metres, of the convex hull of what was seen
    voxels: int = Field(ge=0)
    points: int = Field(ge=0)
    tiles: tuple[str, ...]  #: ids of the tiles that it touches

    @property
    def bounds(self) -> Bounds:
        """The axis-aligned box around footprint and height."""
        xs, ys = zip(*self.footprint, strict=True)
        lower, upper = self.center[2] - self.size[2] / 2, self.center[2] + self.size[2] / 2
        return Bounds(min=(min(xs), min(ys), lower), max=(max(xs), max(ys), upper))


class Motion(Record):
    """How a thing was moved, now_from_before: turned about its upright axis, then shifted."""

    translation: Vector3  #: metres, from the earlier center to the later one
    yaw: (
        float | None
    )  #: radians, counter-clockwise; None: the shape is round, or no survey compared both places


class ObjectRecord(Record):
    """A thing that a survey found changed."""

    number: int = Field(ge=1)  #: within the survey; `object_id` in its coloured cloud
    kind: ObjectKind
    now: Place | None  #: None where it disappeared
    before: Place | None  #: None where it appeared
    motion: Motion | None  #: of what moved
    probability: float = Field(ge=0, le=1)  #: mean over its voxels
    observed_share: float = Field(ge=0, le=1)  #: of it, that both visits could judge
    scans_seen_through: int = Field(ge=0)  #: scans of the other visit that saw through where it is

    @model_validator(mode="after")
    def _placed_as_its_kind_says(self) -> Self:
        told = (self.now is not None, self.before is not None, self.motion is not None)
        expected = {
            "appeared": (True, False, False),
            "disappeared": (False, True, False),
            "moved": (True, True, True),
        }[self.kind]
        if told != expected:
            raise ValueError(
                f"object {self.number}: {self.kind} does not go with (now, before, motion) = {told}"
            )
        return self

    def with_side_of(self, other: ObjectRecord) -> ObjectRecord:
        """Return this thing with the side that `other` tells of it and this does not: one that moved.

        Nobody has laid the two shapes on each other where `other` is no move: then the turn is not known.
        """
        now, before = self.now or other.now, self.before or other.before
        if now is None or before is None:
            return self
        east, north, up = (there - here for here, there in zip(before.center, now.center, strict=True))
        known = self.motion or other.motion
        motion = Motion(translation=(east, north, up), yaw=known.yaw if known else None)
        told = {"kind": "moved", "now": now, "before": before, "motion": motion}
        return self.model_copy(update=told)


class Tileset(Record):
    """How large the tileset of a cloud is (3D Tiles 1.1)."""

    n_points: int = Field(description="all points of the cloud, each in one content", examples=[5181342])
    contents: int = Field(examples=[214])
    bytes: int = Field(description="of all contents", examples=[62181520])
    sha256: str = Field(description="of the same; its first digits are part of their addresses")


class BuiltSummary(Record):
    """What lists tell of maps and of versions alike."""

    map_id: str = Field(examples=["lobby"])
    version: int = Field(examples=[1])  #: 1, 2, ... of the map
    status: MapStatus
    model: str = Field(examples=["voxel-net/1"])  #: `name/version`, whose card gives voxel and tile size
    scan_count: int = Field(description="scans that it is made of, accepted or not", examples=[25])
    bounds: Bounds | None = Field(description="metres, map frame")  #: None until it is built
    counts: dict[str, int] = Field(examples=[{"points": 181342, "tiles": 172, "scans": 25, "accepted": 24}])
    tileset: Tileset | None = Field(
        description="of the fused cloud, `tileset.json`; null until it is built, and of what an earlier release built"
    )
    job_id: str  #: of the job that builds it, and so of its files (`blob_keys.map_folder`)
    problem: Problem | None
    created: Utc
    updated: Utc


class Built(BuiltSummary):
    """What a map and a version of it have in common; a map shows its version in use."""

    settings: dict[str, Any]
    scans: tuple[ScanOutcome, ...]  #: those of the base that were accepted, then the new ones, as requested
    registration: dict[str, Any] | None = Field(
        description="totals of the registration of what is new in it (paper, Table 2); null until it is built",
        examples=[
            {"scans": 25, "accepted": 24, "pairs_possible": 300, "pairs_tried": 61, "pairs_accepted": 58}
        ],
    )


class MapSummary(BuiltSummary):
    """A reference map as it is in use, without what became of each scan."""

    name: str | None
    anchor: Anchor | None = Field(description="where the map lies on the Earth; null: nobody said")
    objects: dict[str, int] = Field(
        description="changed things, by status; empty while no survey tells any",
        examples=[{"new": 2, "still_there": 5, "gone_again": 1, "unknown": 0, "accepted": 3}],
    )


class MapRecord(MapSummary, Built):
    """A reference map as it is in use: the newest of its versions that is ready, and the newest where none is."""


class VersionSummary(BuiltSummary):
    """One state of a map, without what became of each scan."""

    base_version: int | None = Field(description="the version it goes on from; null in the first")
    survey_id: str | None = Field(description="the survey it takes over; null where it is made of scans")


class VersionRecord(VersionSummary, Built):
    """One state of a map; a survey stays with the version that it was compared with."""


class Placement(Record):
    """How sure it is that the scans of a survey stand where they were taken."""

    state: PlacementState = Field(
        description="`in_doubt`: no tile counts as unchanged or changed, and the survey tells no objects; `refused`: no "
        "scan was accepted"
    )
    confidence: float | None = Field(
        ge=0, le=1, description="of the accepted scans together; null where none was", examples=[0.98]
    )


class SurveySummary(Record):
    """A later visit compared with a map, without what became of each scan; `counts` is empty until it is done."""

    survey_id: str = Field(examples=["survey-91c4"])
    map_id: str = Field(examples=["lobby"])
    map_version: int = Field(description="of the map, that the survey is compared with", examples=[1])
    status: SurveyStatus
    model: str = Field(examples=["voxel-net/1"])
    asked_threshold: float | None = Field(description="the client's own; null: the model's is taken")
    threshold: float | None = Field(description="asked for, then the one that was used")
    device_id: str | None
    captured_at: Utc  #: given, else the latest of its scans, else the time of the request
    warnings: Warnings = Field((), description="what is odd about the survey itself: its clock")
    scan_count: int = Field(description="scans that it is made of, accepted or not", examples=[4])
    accepted_count: int = Field(
        0, description="of these, that were placed; 0 until its scans are registered", examples=[3]
    )
    placement: Placement | None = Field(
        description="null until its scans are registered, and in surveys of releases that did not judge it"
    )
    counts: dict[str, int] = Field(
        examples=[{"tiles": 172, "unchanged": 150, "changed": 9, "inconsistent": 1, "unobserved": 12}]
    )
    objects: dict[str, int] | None = Field(
        description="things found, by kind; null until it is done, where the model tells tiles alone, and where the "
        "placement is in doubt",
        examples=[{"appeared": 2, "disappeared": 1, "moved": 1}],
    )
    moving: int | None = Field(
        description="things that moved while the visit lasted, people for the most part; they are no objects",
        examples=[3],
    )
    tileset: Tileset | None = Field(
        description="of the coloured cloud, `tileset.json`; null until it is done, and where the cloud is small enough to "
        "be read whole"
    )
    job_id: str
    problem: Problem | None
    created: Utc
    updated: Utc


class SurveyRecord(SurveySummary):
    """A later visit compared with a map."""

    scans: tuple[ScanOutcome, ...]  #: in the order of the request


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
    message: str = Field(
        description="for people: the stage while it waits or runs, and what became of it once it has ended; of one that "
        "failed the same sentence as `problem.detail`",
        examples=["registering"],
    )
    progress: int = Field(ge=0, le=100, examples=[40])
    created: Utc
    started: Utc | None
    finished: Utc | None
    updated: Utc
    map_id: str
    survey_id: str | None
    model: str | None = Field(description="that a training makes", examples=[None])  #: `name/version`
    problem: Problem | None
    step: str = Field(
        description="that is due or runs; the last one of a job that has ended", examples=["register"]
    )
    attempts: int = Field(description="of this step that crashed; the third ends the job", examples=[0])
    interruptions: int = Field(
        description="of this step from outside, such as a worker that was stopped", examples=[0]
    )


class KeyRecord(Record):
    """An API key, without its secret."""

    key_id: str
    name: str
    scopes: tuple[Scope, ...]
    maps: tuple[str, ...] | None  #: that it is bound to; None: all
    created: Utc
    expires: Utc | None
    revoked: Utc | None

    def may(self, scopes: Collection[Scope]) -> bool:
        """Tell whether the key has one of these scopes."""
        return "admin" in self.scopes or not set(scopes).isdisjoint(self.scopes)


class ChangeRecord(Record):
    """A tile of a survey with what a client needs beside it."""

    tile: TileRecord
    map_id: str
    map_version: int
    survey_id: str
    device_id: str | None = None  #: of the survey
    model: str
    threshold: float | None
    captured_at: Utc
    first_seen: Utc | None = (
        None  #: when a survey first saw this change of the tile; None where there is none
    )
    last_seen: Utc | None = None  #: when one last saw it, before it was gone
    max_score: float | None = None  #: over the surveys that saw it
    change_id: str | None = None  #: the same for as long as the change is told


class WebhookRecord(Record):
    """An address that events are sent to, without its secret."""

    webhook_id: str = Field(examples=["webhook-2d7e"])
    url: str = Field(examples=["https://example.org/hooks/spicd"])
    types: tuple[EventType, ...] | None = Field(description="null: all", examples=[["change.told"]])
    map_id: str | None = Field(description="null: events of all maps, and of none", examples=["lobby"])
    status: WebhookStatus
    reason: str | None = Field(
        description="why it is disabled, or what it missed",
        examples=["the receiver answered 410 Gone"],
    )
    position: int = Field(description="`sequence` of the last event that it needs no more", examples=[1042])
    attempts: int = Field(description="that failed, at the event behind that", examples=[0])
    next_attempt: Utc
    previous_until: Utc | None = Field(description="until when the earlier secret signs as well")
    created: Utc
    updated: Utc


class DeliveryRecord(Record):
    """An event that was sent to a webhook, or is to be."""

    delivery_id: str = Field(examples=["delivery-88a0"])
    webhook_id: str = Field(examples=["webhook-2d7e"])
    kind: DeliveryKind = Field(description="`ping` and `repeat` are sent once, because somebody asked")
    event_id: str = Field(description="the `webhook-id` that it is sent under", examples=["event-6b1f0c"])
    type: str = Field(examples=["change.told"])
    status: DeliveryStatus
    attempts: int = Field(examples=[1])
    answered: int | None = Field(description="HTTP status of the last answer", examples=[204])
    error: str | None = Field(description="why the last attempt failed", examples=["no answer within 15 s"])
    created: Utc
    updated: Utc


class EventRecord(Record):
    """Something that happened."""

    sequence: int  #: in the order of publication, from 1 on, with no gap
    event_id: str
    type: EventType
    map_id: str | None  #: None of scans, which belong to no map
    subject: str  #: id of what it is about
    data: dict[str, Any]
    created: Utc


class SightingRecord(Record):
    """An object of a survey with what a client needs beside it."""

    thing: ObjectRecord
    object_id: str | None  #: of the object that it is a sighting of; None before the survey is ready
    map_id: str
    map_version: int
    survey_id: str
    device_id: str | None = None  #: of the survey
    model: str
    captured_at: Utc
    first_seen: Utc | None  #: of the object, by any survey


class MapObjectRecord(Record):
    """A changed thing of a map, over all surveys that tell objects."""

    object_id: str
    status: ObjectStatus
    last_known: ObjectStatus  #: as the latest survey that looked there told it
    transient: bool  #: it comes and goes
    first_seen: Utc
    last_seen: Utc
    last_looked: Utc
    accepted_in_version: int | None  #: the version of the map that has taken it over
    sightings: int  #: surveys that saw it
    latest: SightingRecord
