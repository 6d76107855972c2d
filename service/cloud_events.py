"""Events as documents: CloudEvents 1.0 in JSON, the same for streams, lists and webhooks.

Plain JSON values. Links are paths on the service, as everywhere in its answers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any

from service.catalog.records import EventRecord, problem_urn, rfc3339

MEDIA_TYPE = "application/cloudevents+json"


def cloud_event(event: EventRecord, *, root: str = "") -> dict[str, Any]:
    """Return the document of an event (CloudEvents 1.0, JSON Event Format 1.0.2); `root` stands before its paths."""
    links = [
        {"href": f"{root}{href}", "rel": rel, "type": media_type}
        for href, rel, media_type in _links(event.type, event.data)
    ]
    return document(
        event.event_id,
        event.type,
        source=f"{root}/maps/{event.map_id}" if event.map_id is not None else f"{root}/",
        subject=event.subject,
        time=event.created,
        sequence=event.sequence,
        data={**event.data, **_problem(event.data), "links": links},
    )


def _problem(data: Mapping[str, Any]) -> dict[str, str]:
    """Return the problem of a job as its document names it; the log has its code."""
    code = data.get("problem")
    return {} if code is None else {"problem": problem_urn(code)}


def document(
    event_id: str,
    type: str,
    *,
    source: str,
    subject: str,
    time: datetime,
    data: Mapping[str, Any],
    sequence: int | None = None,
) -> dict[str, Any]:
    """Return a document of these members; `sequence` is CloudEvents' extension of this name, a string."""
    numbered = {} if sequence is None else {"sequence": str(sequence)}
    return {
        "specversion": "1.0",
        "id": event_id,
        "source": source,
        "type": type,
        "subject": subject,
        "time": rfc3339(time),
        "datacontenttype": "application/json",
        **numbered,
        "data": dict(data),
    }


def _links(type: str, data: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield path, relation and media type of what an event is about, as far as that is still there."""
    json, features = "application/json", "application/geo+json"
    of_map = f"/maps/{data.get('map_id')}"
    thing, _, what = type.partition(".")
    if what in ("deleted", "withdrawn"):
        return
    if thing == "scan":
        yield f"/scans/{data['scan_id']}", "related", json
    elif thing == "version":
        yield f"{of_map}/versions/{data['version']}", "related", json
    elif thing == "model":
        yield f"/models/{data['model'].partition('/')[0]}", "related", json
    elif thing == "change":
        yield f"{of_map}/changes?change={data['change_id']}", "related", features
    elif thing == "object":
        yield f"{of_map}/objects/{data['object_id']}", "related", features
    if data.get("survey_id") is not None:
        yield f"/surveys/{data['survey_id']}", "survey", json
    if data.get("job_id") is not None:
        yield f"/jobs/{data['job_id']}", "monitor", json
