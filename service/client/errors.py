"""What a call can end in.

ClientError                  base; `str()` is one sentence
├── Unreachable              nothing answers at the address, or the connection broke
├── RequestRefused           the service said no; `problem` is its RFC 9457 document
└── JobFailed                the job ended `failed` or `dismissed`; `job` is its document
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

import httpx

Document = Mapping[str, Any]  #: a JSON object, as the API gives it or takes it


class ClientError(Exception):
    """Base of what a call can end in."""


class Unreachable(ClientError):
    """Nothing answers, or the connection broke."""


class RequestRefused(ClientError):
    """The service answered with a problem."""

    def __init__(self, problem: Document, status: int, retry_after_s: float | None = None) -> None:
        super().__init__(sentence(problem))
        self.problem = problem
        self.status = status
        self.retry_after_s = retry_after_s  #: seconds; None where the service named no time


class JobFailed(ClientError):
    """The job ended without a result."""

    def __init__(self, job: Document) -> None:
        super().__init__(sentence(job.get("problem") or {"title": f"the job was {job.get('status')}"}))
        self.job = job


def sentence(problem: Document) -> str:
    """Write a problem document as one sentence."""
    title, detail = problem.get("title"), problem.get("detail")
    return f"{title}: {detail}" if title and detail else str(detail or title or "the service gave no reason")


def refused(answer: httpx.Response) -> RequestRefused:
    """Return the error of an answer that was read and is no success."""
    try:
        problem = answer.json()
    except ValueError:
        problem = None
    if not isinstance(problem, dict):
        problem = {"title": f"the service answered {answer.status_code}", "detail": answer.text[:200]}
    return RequestRefused(problem, answer.status_code, retry_after_s(answer))


def unreachable(url: str, error: httpx.TransportError) -> Unreachable:
    """Return the error of a connection to `url` that did not come about, or broke."""
    if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
        return Unreachable(
            f"nothing answers at {url}; start the service with `spicd up`, or name its address with --url"
        )
    return Unreachable(f"the connection to {url} broke ({type(error).__name__}); try again")


def retry_after_s(answer: httpx.Response) -> float | None:
    """Return `Retry-After` in seconds from now, 0 at least (RFC 9110, Section 10.2.3); None where it is not there."""
    said = answer.headers.get("Retry-After", "").strip()
    if said.isascii() and said.isdigit():
        return float(said)
    try:
        instant = parsedate_to_datetime(said)
    except ValueError:
        return None
    instant = instant if instant.tzinfo else instant.replace(tzinfo=UTC)
    return max(0.0, (instant - datetime.now(UTC)).total_seconds())
