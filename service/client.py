"""The API from Python: what the command line, the demo and a robot's script use.

ClientError                  base; `str()` is one sentence
├── Unreachable              nothing answers at the address
├── RequestRefused           the service said no; `problem` is its RFC 9457 document
└── JobFailed                the job ended `failed` or `dismissed`; `job` is its document
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import httpx

from service import resumable

DEFAULT_URL = "http://127.0.0.1:8000"
PIECE = 1 << 20  #: bytes sent at a time

Document = dict[str, Any]  #: a JSON object as the API gave it
Pose = Sequence[Sequence[float]]  #: (4, 4) row-major, map_from_sensor
OnSent = Callable[[int, int], None]  #: bytes sent, bytes in all
OnProgress = Callable[[Document], None]  #: the job's document after each look


class ClientError(Exception):
    """Base of what a call can end in."""


class Unreachable(ClientError):
    """Nothing answers, or the connection broke."""


class RequestRefused(ClientError):
    """The service answered with a problem."""

    def __init__(self, problem: Document, status: int) -> None:
        super().__init__(sentence(problem))
        self.problem = problem
        self.status = status


class JobFailed(ClientError):
    """The job ended without a result."""

    def __init__(self, job: Document) -> None:
        super().__init__(sentence(job.get("problem") or {"title": f"the job was {job.get('status')}"}))
        self.job = job


def sentence(problem: Document) -> str:
    """Write a problem document as one sentence."""
    title, detail = problem.get("title"), problem.get("detail")
    return f"{title}: {detail}" if title and detail else str(detail or title or "the service gave no reason")


class Client:
    """Calls of the API; a context manager. Every method raises `ClientError` and returns the API's JSON."""

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        key: str | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        """Take the secret of an API key as `key`; None: that of the environment (SPICD_KEY), "": none."""
        self.url = url.rstrip("/")
        timeout = httpx.Timeout(60, connect=5)
        secret = (os.environ.get("SPICD_KEY", "") if key is None else key).strip()
        if not secret.isascii() or not secret.isprintable():
            raise ClientError("the API key has letters that no key has; look at SPICD_KEY")
        headers = {"Authorization": f"Bearer {secret}"} if secret else {}
        self._http = httpx.Client(base_url=self.url, timeout=timeout, transport=transport, headers=headers)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

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
    ) -> Document:
        """Send one PLY or PCD, streamed from disk; `captured_at` is RFC 3339, `pose` map_from_sensor in metres."""
        query = _given(
            filename=filename or (source.name if isinstance(source, Path) else "scan"),
            device_id=device_id,
            captured_at=captured_at,
            pose=None if pose is None else json.dumps([list(row) for row in pose]),
            frame=frame,
        )
        size = source.stat().st_size if isinstance(source, Path) else len(source)
        headers = {"Content-Type": "application/octet-stream", "Content-Length": str(size)}
        content = _pieces(source, size, on_sent)
        return self._json("POST", "/scans", params=query, headers=headers, content=content)

    def upload_scan_resumable(
        self,
        path: Path,
        *,
        memory: resumable.Memory | None = None,
        persistence: resumable.Persistence | None = None,
        on_sent: OnSent | None = None,
        on_wait: resumable.OnWait | None = None,
        **said: Any,
    ) -> Document:
        """Send one PLY or PCD in as many pieces as it takes, and go on where an earlier attempt ended.

        `said` are `filename device_id captured_at pose frame`. Raises `RequestRefused`, and `Unreachable` where nothing
        goes on for longer than `persistence` says.
        """
        try:
            return resumable.upload(
                self._http,
                path,
                said=said,
                memory=memory,
                persistence=persistence,
                on_sent=on_sent,
                on_wait=on_wait,
            )
        except resumable.UploadRefused as refused:
            raise RequestRefused(refused.problem, refused.status) from refused
        except resumable.UploadStalled as stalled:
            raise Unreachable(str(stalled)) from stalled
        except resumable.UploadError as error:
            raise ClientError(str(error)) from error

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
    ) -> Document:
        """Build a reference map; returns `map_id` and `job_id`."""
        about = _given(id=map_id, name=name, model=model, settings=settings, anchor=anchor)
        return self._json("POST", "/maps", json={**about, "scan_ids": list(scan_ids)})

    def maps(self) -> list[Document]:
        """Return every map."""
        return self._all("/maps", "maps")

    def map(self, map_id: str) -> Document:
        """Return one map as its version in use, with its scans."""
        return self._json("GET", f"/maps/{_quoted(map_id)}")

    def delete_map(self, map_id: str) -> None:
        """Remove a map with its versions and surveys."""
        self._send("DELETE", f"/maps/{_quoted(map_id)}")

    def set_anchor(self, map_id: str, anchor: Document | None) -> None:
        """Say where a map lies on the Earth: `longitude latitude height heading`; None: nobody knows."""
        path = f"/maps/{_quoted(map_id)}/anchor"
        self._send("DELETE", path) if anchor is None else self._send("PUT", path, json=anchor)

    # versions

    def create_version(
        self, map_id: str, scan_ids: Sequence[str] = (), *, survey_id: str | None = None
    ) -> Document:
        """Go on from a map's version in use, with further scans or a survey; returns `version` and `job_id`."""
        body = _given(scan_ids=list(scan_ids) or None, survey_id=survey_id)
        return self._json("POST", f"/maps/{_quoted(map_id)}/versions", json=body)

    def versions(self, map_id: str) -> list[Document]:
        """Return every version of a map, newest first."""
        return self._all(f"/maps/{_quoted(map_id)}/versions", "versions")

    def version(self, map_id: str, version: int) -> Document:
        """Return one version of a map with its scans."""
        return self._json("GET", f"/maps/{_quoted(map_id)}/versions/{version}")

    def delete_version(self, map_id: str, version: int) -> None:
        """Remove a version that is not in use."""
        self._send("DELETE", f"/maps/{_quoted(map_id)}/versions/{version}")

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
        idempotency_key: str | None = None,
    ) -> Document:
        """Compare scans with a map; returns `survey_id` and `job_id`."""
        about = _given(captured_at=captured_at, device_id=device_id, model=model, threshold=threshold)
        body = {**about, "scan_ids": list(scan_ids)}
        headers = _given(**{"Idempotency-Key": idempotency_key})
        return self._json("POST", f"/maps/{_quoted(map_id)}/surveys", json=body, headers=headers)

    def surveys(self, map_id: str) -> list[Document]:
        """Return every survey of a map."""
        return self._all(f"/maps/{_quoted(map_id)}/surveys", "surveys")

    def survey(self, survey_id: str) -> Document:
        """Return one survey with its scans and counts."""
        return self._json("GET", f"/surveys/{_quoted(survey_id)}")

    def tiles(self, survey_id: str) -> Document:
        """Return every tile of a survey, a FeatureCollection."""
        return self._json("GET", f"/surveys/{_quoted(survey_id)}/tiles")

    def changes(self, map_id: str, **filters: Any) -> Document:
        """Return one page of changed tiles, each change once.

        Filters are those of the API: `survey repeats bbox datetime min_score limit`.
        """
        return self._json("GET", f"/maps/{_quoted(map_id)}/changes", params=_given(**filters))

    def survey_objects(self, survey_id: str, **filters: Any) -> Document:
        """Return one page of the things that a survey found changed; filters: `kind min_probability limit cursor`."""
        return self._json("GET", f"/surveys/{_quoted(survey_id)}/objects", params=_given(**filters))

    def objects(self, map_id: str, **filters: Any) -> Document:
        """Return one page of the changed things of a map, each once over all surveys.

        Filters are those of the API: `kind status last_known transient bbox datetime min_probability limit cursor`.
        """
        return self._json("GET", f"/maps/{_quoted(map_id)}/objects", params=_given(**filters))

    def object(self, map_id: str, object_id: str) -> Document:
        """Return one changed thing of a map with each sighting of it."""
        return self._json("GET", f"/maps/{_quoted(map_id)}/objects/{_quoted(object_id)}")

    # jobs and models

    def jobs(self) -> list[Document]:
        """Return every job, newest first."""
        return self._all("/jobs", "jobs")

    def job(self, job_id: str) -> Document:
        """Return one job."""
        return self._json("GET", f"/jobs/{_quoted(job_id)}")

    def retry(self, job_id: str) -> Document:
        """Run a failed job again, from the step that it failed in."""
        return self._json("POST", f"/jobs/{_quoted(job_id)}/retry")

    def dismiss(self, job_id: str) -> Document:
        """Stop a job for good."""
        return self._json("DELETE", f"/jobs/{_quoted(job_id)}")

    def wait(self, job_id: str, on_progress: OnProgress | None = None, *, every_s: float = 0.3) -> Document:
        """Return a job's document once it was successful. Raises `JobFailed` when it ended otherwise."""
        while True:
            job = self.job(job_id)
            if on_progress is not None:
                on_progress(job)
            if job["status"] == "successful":
                return job
            if job["status"] in ("failed", "dismissed"):
                raise JobFailed(job)
            time.sleep(every_s)

    def models(self) -> list[Document]:
        """Return the cards of the models."""
        return self._all("/models", "models")

    def train_model(
        self,
        map_id: str,
        *,
        name: str | None = None,
        base: str | None = None,
        minutes: float | None = None,
        epochs: int | None = None,
    ) -> Document:
        """Train a model on a map, from nothing or from `base`; returns `model` and `job_id`."""
        body = _given(name=name, base=base, minutes=minutes, epochs=epochs)
        return self._json("POST", f"/maps/{_quoted(map_id)}/models", json=body)

    def model(self, model: str) -> Document:
        """Return the card of `name/version`."""
        name, _, version = model.partition("/")
        return self._json("GET", f"/models/{_quoted(name)}", params=_given(version=version or None))

    # files

    def download(self, path: str, to: Path) -> Path:
        """Write an answer such as `/surveys/{id}/cloud.ply` to a file, streamed; nothing is left when it fails."""
        aside = to.with_name(to.name + ".part")
        try:
            with self._http.stream("GET", path) as answer:
                if not answer.is_success:
                    answer.read()
                    raise _refused(answer)
                with aside.open("wb") as file:
                    file.writelines(answer.iter_bytes())
            return aside.replace(to)
        except httpx.TransportError as error:
            raise self._unreachable(error) from error
        finally:
            aside.unlink(missing_ok=True)

    def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        try:
            answer = self._http.request(method, path, **request)
        except httpx.TransportError as error:
            raise self._unreachable(error) from error
        if not answer.is_success:
            raise _refused(answer)
        return answer

    def _json(self, method: str, path: str, **request: Any) -> Document:
        document = self._send(method, path, **request).json()
        if not isinstance(document, dict):
            raise ClientError(f"{self.url}{path} did not answer with a JSON object; is this the service?")
        return document

    def _all(self, path: str, name: str) -> list[Document]:
        """Return the list `name` of a document and of the pages that follow it."""
        items: list[Document] = []
        following: str | None = path
        while following:
            page = self._json("GET", following)
            items += page[name]
            links = page.get("links", [])
            following = next((link["href"] for link in links if link.get("rel") == "next"), None)
        return items

    def _unreachable(self, error: httpx.TransportError) -> Unreachable:
        if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
            return Unreachable(
                f"nothing answers at {self.url}; start the service with `spicd up`, or name its address with --url"
            )
        return Unreachable(f"the connection to {self.url} broke ({type(error).__name__}); try again")


def _given(**values: Any) -> dict[str, Any]:
    """Return what was given, without what was left out."""
    return {name: value for name, value in values.items() if value is not None}


def _quoted(name: str) -> str:
    """Quote an id as one segment of a path, whatever was typed."""
    return quote(name, safe="")


def _pieces(source: Path | bytes, size: int, on_sent: OnSent | None) -> Iterator[bytes]:
    if isinstance(source, bytes):
        yield source
        return
    sent = 0
    with source.open("rb") as file:
        while piece := file.read(PIECE):
            yield piece
            sent += len(piece)
            if on_sent is not None:
                on_sent(sent, size)


def _refused(answer: httpx.Response) -> RequestRefused:
    try:
        problem = answer.json()
    except ValueError:
        problem = None
    if not isinstance(problem, dict):
        problem = {"title": f"the service answered {answer.status_code}", "detail": answer.text[:200]}
    return RequestRefused(problem, answer.status_code)
