"""Surveys that a watcher asked for, followed until they have ended: what each found, in a sentence and as an event."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from service.client import Client, Document, RequestRefused, Unreachable
from service.resumable import write_aside

Told = tuple[str, Document]  #: a sentence, and the same as an event
_GONE = (404, 410)


class Following:
    """The surveys that are under way: `surveys.json` in the folder's state, replaced whole."""

    def __init__(self, client: Client, path: Path, *, every_s: float = 5.0) -> None:
        """Ask for each of them every so many seconds at most."""
        self._client, self._path, self._every_s = client, path, every_s
        self._not_before = 0.0
        self._surveys: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.exists() else {}

    def __len__(self) -> int:
        return len(self._surveys)

    def add(self, survey_id: str, visit: str, files: Mapping[str, Sequence[str]]) -> None:
        """Follow a survey; `files` are the names in its visit of each scan, by the scan's id."""
        self._surveys[survey_id] = {
            "visit": visit,
            "files": {one: list(names) for one, names in files.items()},
        }
        self._save()

    def ended(self) -> Iterator[Told]:
        """Yield what became of those that have ended since; nothing while the service does not answer."""
        if time.monotonic() < self._not_before:
            return
        for survey_id, about in list(self._surveys.items()):
            try:
                survey = self._client.survey(survey_id)
            except Unreachable:
                break
            except RequestRefused as refused:
                if refused.status not in _GONE:
                    break
                told = _gone(survey_id, about["visit"])
            else:
                if survey["status"] == "running":
                    continue
                told = _ended(survey, about["visit"], about["files"])
            yield told  # before it is forgotten: whoever is killed here tells it once more
            del self._surveys[survey_id]
            self._save()
        self._not_before = time.monotonic() + self._every_s

    def _save(self) -> None:
        write_aside(self._path, json.dumps(self._surveys, indent=1))


def _gone(survey_id: str, visit: str) -> Told:
    return f"{visit}: survey {survey_id} was deleted", {
        "event": "survey_ended",
        "visit": visit,
        "survey_id": survey_id,
        "status": "deleted",
    }


def _ended(survey: Document, visit: str, files: Mapping[str, Sequence[str]]) -> Told:
    """Write what became of a survey and of each of its scans, under the names of their files."""
    scans = [
        {
            "file": ", ".join(files.get(scan["scan_id"], [])) or None,
            **{name: scan.get(name) for name in ("scan_id", "accepted", "reason", "detail")},
        }
        for scan in survey["scans"]
    ]
    members = ("survey_id", "map_id", "status", "placement", "counts", "objects", "problem")
    event = {"event": "survey_ended", "visit": visit, **{name: survey.get(name) for name in members}}
    sentence = f"{visit}: survey {survey['survey_id']} {'; '.join(_parts(survey, scans))}"
    return sentence, {**event, "scans": scans}


def _parts(survey: Document, scans: Sequence[Document]) -> Iterator[str]:
    placed = sum(scan["accepted"] is True for scan in scans)
    changed = (survey.get("counts") or {}).get("changed")
    found = [f"{number} {kind}" for kind, number in (survey.get("objects") or {}).items() if number]
    parts = [survey["status"], f"{placed} of {len(scans)} scans placed"]
    parts += [] if changed is None else [f"{changed} tiles changed"]
    parts += [f"objects: {', '.join(found)}"] if found else []
    if (survey.get("placement") or {}).get("state") == "in_doubt":
        parts.append("its placement is in doubt")
    yield ", ".join(parts)
    left_out = [scan for scan in scans if scan["accepted"] is False]
    for scan in left_out:
        why = str(scan["reason"] or scan["detail"] or "left out").replace("_", " ")
        yield f"{scan['file'] or scan['scan_id']}: {why}"
    problem = survey.get("problem")
    if problem and not left_out:
        yield str(problem.get("detail") or problem.get("title"))
