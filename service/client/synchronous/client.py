# Made of asynchronous/client.py by `make client`: change that one.
"""The calls of the API, one method each."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from service.client.documents import (
    AcceptedMap,
    AcceptedModel,
    AcceptedSurvey,
    AcceptedVersion,
    JobDocument,
    MapDocument,
    MapSummaryDocument,
    ObjectCollection,
    ObjectHistory,
    ScanDocument,
    ScanOutcome,
    SightingCollection,
    SurveyDocument,
    SurveySummaryDocument,
    TileCollection,
    VersionDocument,
    VersionSummaryDocument,
)
from service.client.errors import Document, JobFailed, retry_after_s
from service.client.requests import Body, OnSent, Pose, csv_lines, given, keyed, quoted, scans_of
from service.client.synchronous.feeds import Feeds
from service.client.uploads import in_pieces
from service.resumable import Memory, OnWait, Persistence

SLOWEST_LOOK_S = 2.0  #: between two looks at a job that takes long

OnProgress = Callable[[JobDocument], None]  #: the job's document after each look


class Client(Feeds):
    """Calls of the API; a context manager. Every method raises `ClientError` and returns the API's JSON.

    What is sent is sent again where the connection breaks or the service is busy, and still done once (`Retries`).
    """

    # scans

    def upload_scan(
        self,
        source: Path | bytes,
        *,
        filename: str | None = None,
        device_id: str | None = None,
        captured_at: str | None = None,
        pose: Pose | None = None,
        frame: str | None = None,
        on_sent: OnSent | None = None,
    ) -> ScanDocument:
        """Send one PLY, PCD, E57, LAS or LAZ, streamed from disk; `captured_at` is RFC 3339, `pose` map_from_sensor in metres.

        `frame` is the name of the frame that the pose leads to, such as `map` or `odom`.

        Raises OSError where the file cannot be read.
        """
        query = given(
            filename=filename or (source.name if isinstance(source, Path) else "scan"),
            device_id=device_id,
            captured_at=captured_at,
            pose=None if pose is None else json.dumps([list(row) for row in pose]),
            frame=frame,
        )
        body = Body(source, on_sent)
        headers = {"Content-Type": "application/octet-stream", "Content-Length": str(body.size)}
        return self._json(ScanDocument, "POST", "/scans", params=query, headers=headers, content=body)

    def upload_scan_resumable(
        self,
        path: Path,
        *,
        memory: Memory | None = None,
        persistence: Persistence | None = None,
        on_sent: OnSent | None = None,
        on_wait: OnWait | None = None,
        **said: Any,
    ) -> ScanDocument:
        """Send one PLY, PCD, E57, LAS or LAZ in as many pieces as it takes, and go on where an earlier attempt ended.

        `said` are `filename device_id captured_at pose frame`. Raises `RequestRefused`, and `Unreachable` where nothing
        goes on for longer than `persistence` says.
        """
        how = {"memory": memory, "persistence": persistence, "on_sent": on_sent, "on_wait": on_wait}
        return in_pieces(self._http, path, said=said, **how)

    def scans(self) -> list[ScanDocument]:
        """Return every scan, newest first."""
        return self._all(ScanDocument, "/scans", "scans")

    def scan(self, scan_id: str) -> ScanDocument:
        """Return what is known of one scan."""
        return self._json(ScanDocument, "GET", f"/scans/{quoted(scan_id)}")

    def delete_scan(self, scan_id: str) -> None:
        """Remove a scan that no map and no survey is made of."""
        self._delete(f"/scans/{quoted(scan_id)}")

    # maps

    def create_map(
        self,
        scan_ids: Sequence[str],
        *,
        map_id: str | None = None,
        name: str | None = None,
        model: str | None = None,
        settings: Document | None = None,
        anchor: Document | None = None,
        poses: Mapping[str, Pose] | None = None,
        idempotency_key: str | None = None,
    ) -> AcceptedMap:
        """Build a reference map; returns `map_id` and `job_id`.

        `poses` are map_from_sensor by the id of the scan, and count in this map alone; others are those of the upload.
        `idempotency_key` is for who may be killed before the answer comes, and asks again then: one a map; left out:
        one a call.
        """
        about = given(id=map_id, name=name, model=model, settings=settings, anchor=anchor)
        body = {**about, **scans_of(scan_ids, poses)}
        return self._json(AcceptedMap, "POST", "/maps", json=body, headers=keyed(idempotency_key))

    def maps(self) -> list[MapSummaryDocument]:
        """Return every map in short; `map` has its scans."""
        return self._all(MapSummaryDocument, "/maps", "maps")

    def map(self, map_id: str) -> MapDocument:
        """Return one map as its version in use, with the first hundred of its scans; `map_scans` has all."""
        return self._json(MapDocument, "GET", f"/maps/{quoted(map_id)}")

    def map_scans(self, map_id: str) -> list[ScanOutcome]:
        """Return what became of every scan of a map, as its version in use has them."""
        return self._all(ScanOutcome, f"/maps/{quoted(map_id)}/scans", "scans")

    def delete_map(self, map_id: str) -> None:
        """Remove a map with its versions and surveys."""
        self._delete(f"/maps/{quoted(map_id)}")

    def set_anchor(self, map_id: str, anchor: Document | None) -> None:
        """Say where a map lies on the Earth: `longitude latitude height heading`; None: nobody knows."""
        path = f"/maps/{quoted(map_id)}/anchor"
        if anchor is None:
            self._delete(path)
        else:
            self._send("PUT", path, json=anchor)

    # versions

    def create_version(
        self,
        map_id: str,
        scan_ids: Sequence[str] = (),
        *,
        survey_id: str | None = None,
        poses: Mapping[str, Pose] | None = None,
        idempotency_key: str | None = None,
    ) -> AcceptedVersion:
        """Go on from a map's version in use, with further scans or a survey; returns `version` and `job_id`.

        `poses` and `idempotency_key` as in `create_map`.
        """
        body = {**given(survey_id=survey_id), **(scans_of(scan_ids, poses) if scan_ids else {})}
        path, headers = f"/maps/{quoted(map_id)}/versions", keyed(idempotency_key)
        return self._json(AcceptedVersion, "POST", path, json=body, headers=headers)

    def versions(self, map_id: str) -> list[VersionSummaryDocument]:
        """Return every version of a map in short, newest first; `version` has its scans."""
        return self._all(VersionSummaryDocument, f"/maps/{quoted(map_id)}/versions", "versions")

    def version(self, map_id: str, version: int) -> VersionDocument:
        """Return one version of a map with the first hundred of its scans; `version_scans` has all."""
        return self._json(VersionDocument, "GET", f"/maps/{quoted(map_id)}/versions/{version}")

    def version_scans(self, map_id: str, version: int) -> list[ScanOutcome]:
        """Return what became of every scan of a version of a map."""
        path = f"/maps/{quoted(map_id)}/versions/{version}/scans"
        return self._all(ScanOutcome, path, "scans")

    def delete_version(self, map_id: str, version: int) -> None:
        """Remove a version that is not in use."""
        self._delete(f"/maps/{quoted(map_id)}/versions/{version}")

    # surveys

    def submit_survey(
        self,
        map_id: str,
        scan_ids: Sequence[str],
        *,
        captured_at: str | None = None,
        device_id: str | None = None,
        model: str | None = None,
        threshold: float | None = None,
        poses: Mapping[str, Pose] | None = None,
        idempotency_key: str | None = None,
    ) -> AcceptedSurvey:
        """Compare scans with a map; returns `survey_id` and `job_id`. `poses` and `idempotency_key` as in `create_map`."""
        about = given(captured_at=captured_at, device_id=device_id, model=model, threshold=threshold)
        body = {**about, **scans_of(scan_ids, poses)}
        path, headers = f"/maps/{quoted(map_id)}/surveys", keyed(idempotency_key)
        return self._json(AcceptedSurvey, "POST", path, json=body, headers=headers)

    def surveys(self, map_id: str) -> list[SurveySummaryDocument]:
        """Return every survey of a map in short; `survey` has its scans."""
        return self._all(SurveySummaryDocument, f"/maps/{quoted(map_id)}/surveys", "surveys")

    def survey(self, survey_id: str) -> SurveyDocument:
        """Return one survey with its scans and counts."""
        return self._json(SurveyDocument, "GET", f"/surveys/{quoted(survey_id)}")

    def delete_survey(self, survey_id: str) -> None:
        """Remove a survey with its results."""
        self._delete(f"/surveys/{quoted(survey_id)}")

    def tiles(self, survey_id: str) -> TileCollection:
        """Return every tile of a survey, a FeatureCollection."""
        return self._json(TileCollection, "GET", f"/surveys/{quoted(survey_id)}/tiles")

    def changes(self, map_id: str, **filters: Any) -> TileCollection:
        """Return one page of changed tiles, each change once.

        Filters are those of the API: `survey repeats bbox datetime min_score limit`.
        """
        return self._json(TileCollection, "GET", f"/maps/{quoted(map_id)}/changes", params=given(**filters))

    def changes_csv(self, map_id: str, **filters: Any) -> Iterator[str]:
        """Yield changed tiles as lines of CSV, the names of the columns first, page after page; filters as above."""
        plain = {"Accept": "text/csv"}
        path = f"/maps/{quoted(map_id)}/changes"
        answer = self._send("GET", path, params=given(**filters), headers=plain)
        for line in csv_lines(answer):
            yield line
        while following := self._joined(answer.request.url, answer.links.get("next", {}).get("url")):
            answer = self._send("GET", following, headers=plain)
            for line in csv_lines(answer)[1:]:
                yield line

    def survey_objects(self, survey_id: str, **filters: Any) -> SightingCollection:
        """Return one page of the things that a survey found changed; filters: `kind min_probability limit cursor`."""
        return self._json(
            SightingCollection, "GET", f"/surveys/{quoted(survey_id)}/objects", params=given(**filters)
        )

    def objects(self, map_id: str, **filters: Any) -> ObjectCollection:
        """Return one page of the changed things of a map, each once over all surveys.

        Filters are those of the API: `kind status last_known transient bbox datetime min_probability limit cursor`.
        """
        return self._json(ObjectCollection, "GET", f"/maps/{quoted(map_id)}/objects", params=given(**filters))

    def object(self, map_id: str, object_id: str) -> ObjectHistory:
        """Return one changed thing of a map with each sighting of it."""
        return self._json(ObjectHistory, "GET", f"/maps/{quoted(map_id)}/objects/{quoted(object_id)}")

    # jobs and models

    def jobs(self) -> list[JobDocument]:
        """Return every job, newest first."""
        return self._all(JobDocument, "/jobs", "jobs")

    def job(self, job_id: str) -> JobDocument:
        """Return one job."""
        return self._json(JobDocument, "GET", f"/jobs/{quoted(job_id)}")

    def retry(self, job_id: str) -> JobDocument:
        """Run a failed job again, from the step that it failed in."""
        return self._json(JobDocument, "POST", f"/jobs/{quoted(job_id)}/retry")

    def dismiss(self, job_id: str) -> JobDocument:
        """Stop a job for good."""
        return self._json(JobDocument, "DELETE", f"/jobs/{quoted(job_id)}")

    def wait(
        self, job_id: str, on_progress: OnProgress | None = None, *, every_s: float = 0.3
    ) -> JobDocument:
        """Return a job's document once it was successful. Raises `JobFailed` when it ended otherwise.

        It is asked for after `every_s` seconds, then less and less often, every two seconds at last; `Retry-After`
        of the service goes before that.
        """
        pause_s = every_s
        while True:
            answer = self._send("GET", f"/jobs/{quoted(job_id)}")
            job = self._document(JobDocument, answer)
            if on_progress is not None:
                on_progress(job)
            if job["status"] == "successful":
                return job
            if job["status"] in ("failed", "dismissed"):
                raise JobFailed(job)
            asked_s = retry_after_s(answer)
            time.sleep(pause_s if asked_s is None else asked_s)
            pause_s = min(pause_s * 1.25, max(every_s, SLOWEST_LOOK_S))

    def models(self) -> list[dict[str, Any]]:
        """Return the cards of the models."""
        return self._all(dict[str, Any], "/models", "models")

    def train_model(
        self,
        map_id: str,
        *,
        name: str | None = None,
        base: str | None = None,
        minutes: float | None = None,
        epochs: int | None = None,
    ) -> AcceptedModel:
        """Train a model on a map, from nothing or from `base`; returns `model` and `job_id`."""
        body = given(name=name, base=base, minutes=minutes, epochs=epochs)
        return self._json(AcceptedModel, "POST", f"/maps/{quoted(map_id)}/models", json=body)

    def model(self, model: str) -> dict[str, Any]:
        """Return the card of `name/version`."""
        name, _, version = model.partition("/")
        return self._json(
            dict[str, Any], "GET", f"/models/{quoted(name)}", params=given(version=version or None)
        )
