"""Sends a scan so that it arrives, however often the connection breaks: the client's side of tus 1.0.0.

UploadError              base; `str()` is one sentence
├── UploadRefused        the service said no; `problem` is its RFC 9457 document, `status` its HTTP status
├── FileChanged          somebody wrote to the file while it was sent
└── UploadStalled        nothing went on for longer than `Persistence.idle_s`; it can be gone on with later

What was sent is on the service's disk, and the next connection, or the next process, goes on there: `Memory` keeps the
addresses of uploads that are begun.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import os
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx

Document = dict[str, Any]  #: a JSON object as the API gave it
OnSent = Callable[[int, int], None]  #: bytes sent, bytes in all
OnWait = Callable[[float, str], None]  #: seconds until the next attempt, and why

PIECE_TYPE = "application/offset+octet-stream"
_READ = 1 << 16
_TUS = {"Tus-Resumable": "1.0.0"}
_AGAIN = frozenset({408, 409, 423, 425, 429, 500, 502, 503, 504, 507})  #: statuses that a wait may mend
_GONE = frozenset({404, 410})
_random = secrets.SystemRandom()


class UploadError(Exception):
    """Base of what an upload can end in."""


class UploadRefused(UploadError):
    """The service does not take the file, or may not be asked."""

    def __init__(self, problem: Document, status: int) -> None:
        super().__init__(_sentence(problem))
        self.problem, self.status = problem, status


class FileChanged(UploadError):
    """What was sent is neither what the file was nor what it is."""


class UploadStalled(UploadError):
    """Nothing went on for too long."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Persistence:
    """How long an upload is tried, in seconds, and how much goes in one piece, in bytes."""

    idle_s: float = 300.0  #: without one further byte; then UploadStalled
    first_wait_s: float = 0.5  #: doubled after each attempt, with jitter, until a byte went through
    longest_wait_s: float = 30.0
    longest_retry_after_s: float = 600.0  #: of what the service asks for
    connect_s: float = 10.0
    silence_s: float = 30.0  #: of a connection, before it counts as broken
    first_piece: int = 8 << 20  #: doubled with each that came whole; halved where none of it was kept
    least_piece: int = 64 << 10
    largest_piece: int = 64 << 20


class Memory:
    """The addresses of uploads that are begun, in a file that is replaced whole; without a path, in this process."""

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._urls: dict[str, str] = {}
        if path is not None:
            with contextlib.suppress(OSError, ValueError):
                self._urls = {str(key): str(url) for key, url in json.loads(path.read_text()).items()}

    def find(self, key: str) -> str | None:
        """Return where an upload goes on; None where it was not begun."""
        return self._urls.get(key)

    def keep(self, key: str, url: str) -> None:
        """Note where an upload goes on."""
        self._urls[key] = url
        self._save()

    def forget(self, key: str) -> None:
        """Drop an upload that has ended."""
        if self._urls.pop(key, None) is not None:
            self._save()

    def ended(self, key: str, *, known: bool = False) -> None:  # noqa: ARG002  # for who wants to tell it
        """Drop an upload that became a scan, or a scan that was `known` before."""
        self.forget(key)

    def _save(self) -> None:
        if self._path is not None:
            write_aside(self._path, json.dumps(self._urls, indent=1))


def default_memory() -> Memory:
    """Return the memory of this user: `uploads.json` in `$XDG_STATE_HOME/spicd`; where it cannot be kept, of this process."""
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    path = Path(home) / "spicd" / "uploads.json"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError:
        return Memory()
    return Memory(path) if os.access(path.parent, os.W_OK) else Memory()


def write_aside(path: Path, text: str) -> None:
    """Replace a file: whoever is killed, and whenever, it is the old one or the new one."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with aside.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def upload(
    http: httpx.Client,
    path: Path,
    *,
    said: Mapping[str, Any] | None = None,
    memory: Memory | None = None,
    persistence: Persistence | None = None,
    on_sent: OnSent | None = None,
    on_wait: OnWait | None = None,
) -> Document:
    """Send a PLY, PCD, E57, LAS or LAZ and return the scan that it became, as GET /scans/{id} shows it.

    `http` has the base URL and the key. `said` is what POST /scans takes beside the file (`filename captured_at
    device_id pose frame`). An upload of the same file that `memory` knows is gone on with. At the end the SHA-256 that
    the service tells is held against that of the file. Raises UploadError, and OSError where the file cannot be read.
    """
    sending = _Sending(
        http=http,
        path=path,
        said={"filename": path.name, **(said or {})},
        memory=memory or Memory(),
        persistence=persistence or Persistence(),
        on_sent=on_sent or (lambda _sent, _size: None),
        on_wait=on_wait or (lambda _seconds, _why: None),
    )
    return sending.run()


class _Again(Exception):
    """The service asks to come again, or the connection broke."""

    def __init__(self, why: str, after_s: float = 0.0) -> None:
        super().__init__(why)
        self.after_s = after_s


@dataclass(kw_only=True)
class _Sending:
    """One file on its way."""

    http: httpx.Client
    path: Path
    said: Mapping[str, Any]
    memory: Memory
    persistence: Persistence
    on_sent: OnSent
    on_wait: OnWait
    offset: int = 0  #: bytes that the service has for sure
    scan_id: str | None = None
    known: bool = False  #: the service had the scan before this upload was begun
    failures: int = 0  #: attempts since a byte went through last
    since: float = field(default_factory=time.monotonic)  #: when one did

    def __post_init__(self) -> None:
        status = self.path.stat()
        self.size, self.changed = status.st_size, status.st_mtime_ns
        self.piece = self.persistence.first_piece
        self.metadata = _metadata(self.said)
        about = [
            str(self.http.base_url),
            str(self.path.resolve()),
            self.size,
            status.st_mtime_ns,
            self.metadata,
        ]
        self.key = hashlib.sha256(json.dumps(about).encode()).hexdigest()[:32]

    def run(self) -> Document:
        while True:
            begun_at = self.offset
            try:
                scan = self._attempt()
            except (_Again, httpx.TransportError) as error:
                if self.offset > begun_at:
                    self.failures, self.since = 0, time.monotonic()
                self._wait(error)
                continue
            except UploadRefused as refused:
                if refused.status not in (401, 403):
                    self.memory.forget(self.key)
                raise
            self._check(scan)
            self.memory.ended(self.key, known=self.known)
            return scan

    def _attempt(self) -> Document:
        """Go on from wherever the service is, to the end."""
        url = self.memory.find(self.key)
        url = url if url is not None and self._look(url) else self._begin()
        self.on_sent(self.offset, self.size)
        while self.offset < self.size:
            self._send_piece(url)
        upload = self._upload(url)
        self.scan_id = self.scan_id or upload.get("scan_id")
        if self.scan_id is None:
            raise _Again("the service has all bytes and is not done with them")
        scan = self._json("GET", f"/scans/{self.scan_id}")
        self.known = _instant(scan.get("created")) < _instant(upload.get("created"))
        return scan

    def _upload(self, url: str) -> Document:
        """Return what is known of an upload; nothing where it was a scan already and has been forgotten since."""
        if self.scan_id is None:
            return self._json("GET", url)
        with contextlib.suppress(ValueError):
            if (answer := self._send("GET", url)).is_success:
                return dict(answer.json())
        return {}

    def _begin(self) -> str:
        headers = {**_TUS, "Upload-Length": str(self.size), "Upload-Metadata": self.metadata}
        url = str(self._ask("POST", "/uploads", headers=headers).headers["Location"])
        self.offset, self.scan_id = 0, None
        self.memory.keep(self.key, url)
        return url

    def _look(self, url: str) -> bool:
        """Ask how far an upload is; False where it is gone, or was refused and is to be begun anew."""
        answer = self._send("HEAD", url, headers=_TUS)
        if answer.status_code in _AGAIN:
            raise _again(answer)
        if not answer.is_success:
            self.memory.forget(self.key)
            return False
        offset = int(answer.headers["Upload-Offset"])
        if offset <= self.offset and self.failures:
            self.piece = max(self.persistence.least_piece, self.piece // 2)
        self._advance(offset)
        self.scan_id = answer.headers.get("Scan-Id")
        return True

    def _send_piece(self, url: str) -> None:
        length = min(self.piece, self.size - self.offset)
        headers = {
            **_TUS,
            "Content-Type": PIECE_TYPE,
            "Content-Length": str(length),
            "Upload-Offset": str(self.offset),
        }
        answer = self._ask("PATCH", url, headers=headers, content=self._bytes(length))
        self._advance(int(answer.headers["Upload-Offset"]))
        self.scan_id = answer.headers.get("Scan-Id")
        self.piece = min(self.persistence.largest_piece, self.piece * 2)

    def _advance(self, offset: int) -> None:
        if offset > self.offset:
            self.failures, self.since = 0, time.monotonic()
        self.offset = offset

    def _bytes(self, length: int) -> Iterator[bytes]:
        sent, end = self.offset, self.offset + length
        with self.path.open("rb") as file:
            file.seek(sent)
            while sent < end and (data := file.read(min(_READ, end - sent))):
                yield data
                sent += len(data)
                self.on_sent(sent, self.size)
        if sent < end:
            raise FileChanged(f"{self.path.name} has become shorter while it was sent")

    def _wait(self, error: Exception) -> None:
        """Wait before the next attempt: longer after each, with jitter, and as long as the service asks."""
        limits, why = self.persistence, self._why(error)
        idle = time.monotonic() - self.since
        if idle > limits.idle_s:
            raise UploadStalled(
                f"{self.path.name}: {why}; {self.offset} of {self.size} bytes are there and none went through for "
                f"{idle:.0f} s, the next attempt goes on from them"
            ) from error
        longest = min(limits.longest_wait_s, limits.first_wait_s * 2 ** min(self.failures, 16))
        asked = min(getattr(error, "after_s", 0.0), limits.longest_retry_after_s)
        seconds = max(asked, 0.0) + _random.uniform(longest / 2, longest)
        self.failures += 1
        self.on_wait(seconds, why)
        time.sleep(seconds)

    def _why(self, error: Exception) -> str:
        """Return in words what went wrong, with the address where nothing answered."""
        if isinstance(error, _Again):
            return str(error)
        return f"the service at {str(self.http.base_url).rstrip('/')} does not answer ({_in_words(error)})"

    def _check(self, scan: Document) -> None:
        """Hold what arrived against the file. Raises FileChanged, UploadRefused."""
        status = self.path.stat()
        if (status.st_size, status.st_mtime_ns) != (self.size, self.changed):
            self.memory.forget(self.key)
            raise FileChanged(
                f"{self.path.name} was written to while it was sent; send it again once it is whole"
            )
        with self.path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if scan.get("sha256") != digest:
            self.memory.forget(self.key)
            detail = (
                f"the service has the SHA-256 {scan.get('sha256')} of {self.path.name}, which has {digest}; "
                f"delete scan {scan.get('scan_id')} and send it again"
            )
            raise UploadRefused({"title": "Another file arrived", "detail": detail}, 0)

    def _ask(self, method: str, url: str, **request: Any) -> httpx.Response:
        answer = self._send(method, url, **request)
        if answer.status_code in _AGAIN:
            raise _again(answer)
        if method == "PATCH" and answer.status_code in _GONE:
            raise _Again("the upload is gone and is begun anew")
        if not answer.is_success:
            raise UploadRefused(_problem(answer), answer.status_code)
        return answer

    def _json(self, method: str, url: str) -> Document:
        document: Document = self._ask(method, url).json()
        return document

    def _send(self, method: str, url: str, **request: Any) -> httpx.Response:
        limits = self.persistence
        timeout = httpx.Timeout(limits.silence_s, connect=limits.connect_s)
        return self.http.request(method, url, timeout=timeout, **request)


def _in_words(error: BaseException) -> str:
    """Return what happened to a connection, as the system says it: `connection refused`."""
    if isinstance(error, httpx.TimeoutException):
        return "no answer in time"
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.strerror:
            return cause.strerror.lower()
        cause = cause.__cause__ or cause.__context__
    return str(error).lower() or type(error).__name__


def _instant(said: Any) -> datetime:
    """Read an instant of a document; where there is none the earliest of all."""
    try:
        return datetime.fromisoformat(said).astimezone(UTC)
    except (TypeError, ValueError):
        return datetime.min.replace(tzinfo=UTC)


def _again(answer: httpx.Response) -> _Again:
    after = answer.headers.get("Retry-After", "")
    seconds = float(after) if after.isascii() and after.isdigit() else 0.0
    return _Again(_sentence(_problem(answer)), seconds)


def _problem(answer: httpx.Response) -> Document:
    with contextlib.suppress(ValueError):
        problem = answer.json()
        if isinstance(problem, dict):
            return problem
    return {"title": f"the service answered {answer.status_code}", "detail": answer.text[:200]}


def _sentence(problem: Document) -> str:
    return ": ".join(str(problem[name]) for name in ("title", "detail") if problem.get(name))


def _metadata(said: Mapping[str, Any]) -> str:
    """Return `Upload-Metadata`: names, each with its value in base64; what is None is left out."""
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in said.items()
        if value is not None
    }
    return ",".join(f"{name} {base64.b64encode(text.encode()).decode()}" for name, text in texts.items())
