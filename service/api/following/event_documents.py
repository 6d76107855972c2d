"""Events as clients get them: one schema for each sort, told apart by `type`, so that `data` has a type of its own.

They describe what `service.cloud_events` makes; a test holds every event against them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, RootModel

from service.api.http.answering.documents import Document, Link
from service.catalog.records import ObjectKind, ObjectStatus
from service.catalog.steps import JobKind

MapId = Annotated[str, Field(examples=["lobby"])]
JobId = Annotated[str, Field(examples=["job-5f0c"])]
SurveyId = Annotated[str, Field(examples=["survey-91c4"])]
DeviceId = Annotated[
    str | None, Field(description="of the robot; null where nobody said", examples=["robot-7"])
]
Score = Annotated[float, Field(examples=[0.97])]
Instant = Annotated[str, Field(description="RFC 3339", examples=["2026-03-04T09:00:00Z"])]
Sequence = Annotated[
    str,
    Field(
        description="number in the order of publication, 1, 2, 3 ...: compare as numbers, and give it as `after`",
        examples=["1042"],
    ),
]


class Data(Document):
    """What every event's data has; more members may come."""

    links: list[Link] = Field(description="to what it is about, as far as that is still there")


class ScanData(Data):
    """A scan, which is of no map yet."""

    scan_id: str = Field(examples=["scan-2b1f"])
    device_id: DeviceId


class JobEndedData(Data):
    """A job that has ended."""

    map_id: MapId
    job_id: JobId
    kind: JobKind
    status: Literal["successful", "failed", "dismissed"]
    problem: str | None = Field(
        description="`type` of the problem in the job's document; null where it was successful",
        examples=["urn:spicd:problem:registration_failed"],
    )
    survey_id: str | None = Field(description="that it worked on", examples=["survey-91c4"])
    model: str | None = Field(description="that it trained, `name/version`", examples=[None])


class VersionData(Data):
    """A version of a map that was built, or could not be."""

    map_id: MapId
    version: int = Field(examples=[2])
    job_id: JobId


class SurveyData(Data):
    """A survey that has its result, or none."""

    map_id: MapId
    survey_id: SurveyId
    device_id: DeviceId
    captured_at: Instant
    counts: dict[str, int] = Field(
        description="tiles, by state; empty where it failed", examples=[{"tiles": 172, "changed": 9}]
    )
    objects: dict[str, int] | None = Field(
        description="things found, by kind; null where the survey tells none",
        examples=[{"appeared": 2, "moved": 1}],
    )
    job_id: JobId


class SurveyDeletedData(Data):
    """A survey that was deleted."""

    map_id: MapId
    survey_id: SurveyId


class ModelData(Data):
    """A model whose training ended."""

    map_id: MapId
    model: str = Field(description="`name/version`", examples=["lobby-net/1"])
    job_id: JobId


class ChangeData(Data):
    """A change of a tile, as it was when it was told."""

    map_id: MapId
    change_id: str = Field(examples=["change-5c02"])
    tile_id: str = Field(examples=["tile_004_002_000"])
    survey_id: str = Field(description="of the visit that tells it", examples=["survey-91c4"])
    first_seen: Instant
    last_seen: Instant
    max_score: Score


class ChangeUpdatedData(ChangeData):
    """A change of a tile that was told before, as it is known now."""

    only_times: bool = Field(
        description="true: nothing is new but when it was seen last; webhooks that name no types do not get it",
        examples=[True],
    )


class ChangeWithdrawnData(Data):
    """A change that no visit sees any more, or that turned out to be part of another."""

    map_id: MapId
    change_id: str = Field(examples=["change-5c02"])
    tile_id: str = Field(examples=["tile_004_002_000"])
    merged_into: str | None = Field(
        description="the older change that it is part of", examples=["change-11fe"]
    )


class ObjectData(Data):
    """A changed thing: what is known of it by now."""

    map_id: MapId
    object_id: str = Field(examples=["object-77aa"])
    kind: ObjectKind
    status: ObjectStatus
    survey_id: str = Field(description="of the latest sighting", examples=["survey-91c4"])
    probability: Score


class ObjectUpdatedData(ObjectData):
    """A changed thing that was told before: what is known of it by now."""

    only_times: bool = Field(
        description="true: nothing is new but when it was seen last, or looked at; webhooks that name no types do not get it",
        examples=[True],
    )


class ObjectWithdrawnData(Data):
    """An object that no visit sees any more, or that turned out to be part of another."""

    map_id: MapId
    object_id: str = Field(examples=["object-77aa"])


class MapDeletedData(Data):
    """A map that was deleted, and all that was of it."""

    map_id: MapId


class PingData(Data):
    """A test that somebody asked for."""

    webhook_id: str = Field(examples=["webhook-2d7e"])


class Envelope(Document):
    """What every event has (CloudEvents 1.0)."""

    specversion: Literal["1.0"]
    id: str = Field(
        description="of the event, the same on every way and each time it is sent", examples=["event-6b1f0c"]
    )
    source: str = Field(description="path of the map, or of the service", examples=["/maps/lobby"])
    subject: str = Field(
        description="id of what it is about: of a scan, job, survey, change, object or map; of a version or model "
        "`map/version` and `name/version`",
        examples=["change-5c02"],
    )
    time: str = Field(description="of publication, RFC 3339", examples=["2026-03-05T12:00:00Z"])
    datacontenttype: Literal["application/json"]


class ScanEvent(Envelope):
    """A scan is kept, or was deleted."""

    type: Literal["scan.uploaded", "scan.deleted"]
    sequence: Sequence
    data: ScanData


class JobEndedEvent(Envelope):
    """A job was successful, failed or was dismissed, also where it is gone with what was deleted."""

    type: Literal["job.ended"]
    sequence: Sequence
    data: JobEndedData


class VersionEvent(Envelope):
    """A version of a map was built, or could not be."""

    type: Literal["version.ready", "version.failed"]
    sequence: Sequence
    data: VersionData


class SurveyEvent(Envelope):
    """A survey has its result, or none."""

    type: Literal["survey.ready", "survey.failed"]
    sequence: Sequence
    data: SurveyData


class SurveyDeletedEvent(Envelope):
    """A survey was deleted."""

    type: Literal["survey.deleted"]
    sequence: Sequence
    data: SurveyDeletedData


class ModelEvent(Envelope):
    """A training ended."""

    type: Literal["model.ready", "model.failed"]
    sequence: Sequence
    data: ModelData


class ChangeEvent(Envelope):
    """A change of a tile is seen for the first time."""

    type: Literal["change.told"]
    sequence: Sequence
    data: ChangeData


class ChangeUpdatedEvent(Envelope):
    """What is known of a change is another than was told."""

    type: Literal["change.updated"]
    sequence: Sequence
    data: ChangeUpdatedData


class ChangeWithdrawnEvent(Envelope):
    """No visit sees a change any more, or a late visit joined it with an older one."""

    type: Literal["change.withdrawn"]
    sequence: Sequence
    data: ChangeWithdrawnData


class ObjectEvent(Envelope):
    """An object is seen for the first time, is gone or there again, or was taken over by a version."""

    type: Literal["object.told", "object.gone_again", "object.seen_again", "object.accepted"]
    sequence: Sequence
    data: ObjectData


class ObjectUpdatedEvent(Envelope):
    """Something else is known of an object than was told."""

    type: Literal["object.updated"]
    sequence: Sequence
    data: ObjectUpdatedData


class ObjectWithdrawnEvent(Envelope):
    """No visit sees an object any more, or it turned out to be part of another."""

    type: Literal["object.withdrawn"]
    sequence: Sequence
    data: ObjectWithdrawnData


class MapDeletedEvent(Envelope):
    """A map was deleted, and all that is of it; its changes and objects are not withdrawn one by one."""

    type: Literal["map.deleted"]
    sequence: Sequence
    data: MapDeletedData


class PingEvent(Envelope):
    """A test of a webhook; it has no number, for it is in no list."""

    type: Literal["webhook.ping"]
    data: PingData


AnyEvent = (
    ScanEvent
    | JobEndedEvent
    | VersionEvent
    | SurveyEvent
    | SurveyDeletedEvent
    | ModelEvent
    | ChangeEvent
    | ChangeUpdatedEvent
    | ChangeWithdrawnEvent
    | ObjectEvent
    | ObjectUpdatedEvent
    | ObjectWithdrawnEvent
    | MapDeletedEvent
)


class CloudEvent(RootModel[Annotated[AnyEvent, Field(discriminator="type")]]):
    """An event (CloudEvents 1.0); `type` tells which. Types are added, so pass over one that you do not know."""


class WebhookEvent(RootModel[Annotated[AnyEvent | PingEvent, Field(discriminator="type")]]):
    """What is sent to a webhook: an event as in lists and streams, or a test."""
