"""Errors as clients see them: RFC 9457 problem documents, every code in one table."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Annotated, Any
from uuid import uuid4

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, BeforeValidator, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from service.api.http.guards.methods import allowed, is_head
from service.api.http.reading.codings import ACCEPTED
from service.catalog.records import Problem, problem_urn
from service.errors import ServiceError, Unavailable, is_disk_full

log = logging.getLogger(__name__)

MAX_ERRORS = 20  #: values that one answer complains of
MEDIA_TYPE = "application/problem+json"

#: code -> (HTTP status, title). A status of None is that of a failed job, which no request answers with.
PROBLEMS: dict[str, tuple[int | None, str]] = {
    "not_found": (404, "There is no such thing"),
    "no_such_process": (404, "There is no such process"),
    "no_such_job": (404, "There is no such job"),
    "result_not_ready": (404, "The job has not ended"),
    "not_ready": (409, "It is not ready yet"),
    "failed": (409, "It failed, and does not become ready by waiting"),
    "conflict": (409, "It is in the way of something else"),
    "bad_request": (422, "A value cannot be used"),
    "invalid_request": (422, "The request does not match the API"),
    "scan_unreadable": (422, "The file is no sound scan"),
    "gone": (410, "It is not kept any more"),
    "too_large": (413, "The body is too large"),
    "too_slow": (408, "The body took too long"),
    "wrong_media_type": (415, "The media type is not taken here"),
    "not_acceptable": (406, "No answer is of a media type that is accepted"),
    "wrong_encoding": (415, "The content coding is not taken here"),
    "wrong_digest": (400, "The body is not what its digest says"),
    "broken_request": (400, "The request is no sound HTTP"),
    "header_too_large": (431, "The header is too large"),
    "range_not_satisfiable": (416, "There are no such bytes"),
    "unauthorized": (401, "An API key is needed"),
    "forbidden": (403, "This may not be done here"),
    "queue_full": (429, "Too many jobs wait"),
    "offset_mismatch": (409, "The upload goes on elsewhere"),
    "checksum_mismatch": (460, "The piece is not what was sent"),
    "upload_busy": (423, "Another request writes to the upload"),
    "too_many_uploads": (429, "Too many uploads are begun"),
    "tus_version": (412, "The version of the upload protocol is not spoken here"),
    "tus_malformed": (400, "The request breaks the upload protocol"),
    "disk_full": (507, "The disk is full"),
    "unavailable": (503, "A part of the service does not answer"),
    "queue_unavailable": (503, "The job queue does not answer"),
    "database_unavailable": (503, "The database does not answer"),
    "blobs_unavailable": (503, "The blob store does not answer"),
    "unhealthy": (503, "A part of the service does not answer"),
    "method_not_allowed": (405, "The method is not allowed here"),
    "idempotency_key_malformed": (400, "The Idempotency-Key cannot be read"),
    "idempotency_key_reused": (422, "The Idempotency-Key came with another request"),
    "idempotency_key_in_use": (409, "The request is being carried out"),
    "incomplete_body": (400, "The body ended early"),
    "internal": (500, "The service failed"),
    "scan_too_large": (None, "The scan has too many points"),
    "scan_units": (None, "The scan is not in metres"),
    "scan_far_away": (None, "The scan lies far from its origin"),
    "registration_failed": (None, "No scan could be registered"),
    "map_failed": (None, "The scans do not make a map"),
    "training_failed": (None, "The model could not be trained"),
    "detector_unavailable": (None, "The model cannot be used"),
    "pipeline_error": (None, "The job failed"),
    "worker_died": (None, "A worker died"),
    "out_of_memory": (None, "The step needed too much memory"),
    "process_lost": (None, "A process of the job ended"),
    "timed_out": (None, "A step took too long"),
    "function_refused": (None, "The queue held a call that no worker makes"),
    "dismissed": (None, "The job was dismissed"),
}

#: Types that a standard names (OGC 18-062r2, Section 7); all others are ours.
_OGC = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0"
_TYPES = {
    "no_such_process": f"{_OGC}/no-such-process",
    "no_such_job": f"{_OGC}/no-such-job",
    "result_not_ready": f"{_OGC}/result-not-ready",
}


class InvalidValue(BaseModel):
    """One value that does not match, and where it stands."""

    place: str = Field(examples=["query.limit"])
    value: Any = Field(examples=[0])
    detail: str = Field(examples=["Input should be greater than or equal to 1"])


def _is_none(value: object) -> bool:
    return value is None


class ProblemDocument(BaseModel):
    """A problem (RFC 9457, Section 3), of a request or of a job; what it does not have is left out.

    `type` is stable, docs/problems.md has all of them; `detail` is for people and may change.
    """

    type: str = Field(examples=["urn:spicd:problem:not_found"])
    title: str = Field(examples=["There is no such thing"])
    status: int | None = Field(
        default=None,
        exclude_if=_is_none,
        description="of the answer; the problem of a job may have none",
        examples=[404],
    )
    detail: str = Field(examples=["no map 'lobby'; GET /maps lists those there are"])
    instance: str | None = Field(
        default=None,
        exclude_if=_is_none,
        description="with `internal` alone: what to look for in the service's log",
    )
    errors: list[InvalidValue] | None = Field(
        default=None,
        exclude_if=_is_none,
        description="with `invalid_request` alone: the values that do not match",
    )


def _type(code: str) -> str:
    return _TYPES.get(code, problem_urn(code))


def problem_of(problem: Problem | None) -> ProblemDocument | None:
    """Return the document of a failed job's problem; an unknown code keeps its type under a general title."""
    if problem is None:
        return None
    status, title = PROBLEMS.get(problem.code, PROBLEMS["pipeline_error"])
    return ProblemDocument(type=_type(problem.code), title=title, status=status, detail=problem.detail)


#: The problem of a record as its document shows it.
JobProblem = Annotated[ProblemDocument | None, BeforeValidator(problem_of)]

#: What may be wrong with any body; documented in this order.
BODY = (
    "incomplete_body",
    "broken_request",
    "wrong_digest",
    "too_slow",
    "too_large",
    "wrong_media_type",
    "wrong_encoding",
    "bad_request",
    "invalid_request",
    "disk_full",
    "unavailable",
    "database_unavailable",
    "blobs_unavailable",
)


def response(
    code: str, detail: str, *, headers: dict[str, str] | None = None, **members: Any
) -> JSONResponse:
    """Answer a request that ended in `code`; `members` extend the document (RFC 9457, Section 3.2)."""
    status, title = PROBLEMS[code]
    status = 500 if status is None else status
    content = {"type": _type(code), "title": title, "status": status, "detail": detail, **members}
    return JSONResponse(content, status, headers=headers, media_type=MEDIA_TYPE)


def job_failed(problem: Problem) -> JSONResponse:
    """Answer who asks for the results of a job that failed or was dismissed: its problem, as a conflict."""
    status = 409
    _, title = PROBLEMS.get(problem.code, PROBLEMS["pipeline_error"])
    content = {"type": _type(problem.code), "title": title, "status": status, "detail": problem.detail}
    return JSONResponse(content, status, media_type=MEDIA_TYPE)


_RETRY_AFTER = {"description": "seconds, where it helps to wait", "schema": {"type": "integer"}}


def located(example: str, what: str) -> dict[str, Any]:
    """Return the `headers` of a described answer that says where a thing is which was made."""
    schema = {"type": "string", "examples": [example]}
    return {"Location": {"description": f"path of the {what}", "required": True, "schema": schema}}


def documented(*codes: str) -> dict[int | str, dict[str, Any]]:
    """Return the `responses` of a route that may end in these codes, for the generated API description."""
    answers: dict[int | str, dict[str, Any]] = {}
    for code in codes:
        status, title = PROBLEMS[code]
        if status is None:
            raise ValueError(f"{code} is the problem of a job, not of a request")
        meaning = f"{title} (`{_type(code)}`)"
        known = answers.get(status)
        answers[status] = {
            "description": meaning if known is None else f"{known['description']}; {meaning}",
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDocument"}}},
        }
        if status in (423, 429, 503) or code == "idempotency_key_in_use":
            answers[status]["headers"] = {"Retry-After": _RETRY_AFTER}
    return answers


#: What any route may answer that needs the database or the blob store.
OUTAGES = documented("database_unavailable", "blobs_unavailable", "unavailable")

#: The answers of a route that names one thing, of one that lists, and of one that gives what a job makes.
NAMED = documented("not_found", "invalid_request")
LISTED = documented("invalid_request", "bad_request")
MADE = documented("not_found", "not_ready", "failed", "invalid_request")


def add_handlers(app: FastAPI) -> None:
    """Make every error of `app` a problem document."""
    app.add_exception_handler(ServiceError, _service_error)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(ClientDisconnect, _disconnected)
    app.add_exception_handler(Exception, _unexpected)


def _service_error(_request: Request, error: Exception) -> Response:
    code = error.code if isinstance(error, ServiceError) and error.code in PROBLEMS else "internal"
    if isinstance(error, Unavailable) and is_disk_full(error):  # Redis says that it cannot write
        return response(
            "disk_full", "the disk of the job queue is full; delete surveys or maps, or enlarge it"
        )
    headers = {}
    if code == "unauthorized":
        headers["WWW-Authenticate"] = 'Bearer realm="spicd"'  # RFC 6750, Section 3
    if code == "wrong_encoding":
        headers["Accept-Encoding"] = ACCEPTED  # RFC 7694, Section 3
    if (wait := getattr(error, "retry_after_s", None)) is not None:
        headers["Retry-After"] = str(wait)
    return response(code, str(error), headers=headers or None)


def _invalid(_request: Request, error: Exception) -> Response:
    entries: Sequence[Any] = error.errors() if isinstance(error, RequestValidationError) else ()
    errors = [_invalid_value(entry) for entry in entries[:MAX_ERRORS]]
    first = errors[0] if errors else {"place": "request", "detail": "it does not match"}
    return response("invalid_request", f"{first['place']}: {first['detail']}", errors=errors)


def _invalid_value(entry: dict[str, Any]) -> dict[str, Any]:
    value = entry.get("input")
    shown = value if isinstance(value, str | int | float | bool | None) else repr(value)
    if isinstance(shown, float) and not abs(shown) < float("inf"):
        shown = repr(shown)
    if isinstance(shown, str) and len(shown) > 200:
        shown = shown[:200] + "..."
    place = ".".join(str(part) for part in entry.get("loc", ()))
    detail = str(entry.get("msg", "")).removeprefix("Value error, ")
    if isinstance(shown, str):
        shown = _encodable(shown)
    return {"place": _encodable(place), "value": shown, "detail": _encodable(detail)}


def _encodable(text: str) -> str:
    """Replace a lone surrogate, which JSON can spell and UTF-8 cannot, by a question mark."""
    return text.encode("utf-8", "replace").decode()


def _http_error(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    headers = dict(error.headers or {}) if isinstance(error, HTTPException) else None
    if status == 404:
        return response("not_found", f"no such path: {request.url.path}; GET /docs shows those there are")
    if status == 405:
        names = ", ".join(allowed(request.app.routes, request.scope))
        method = "HEAD" if is_head(request.scope) else request.method
        detail = f"{method} is not allowed here; {names} are"
        return response("method_not_allowed", detail, headers={"Allow": names})
    if status < 500:
        detail = error.detail if isinstance(error, HTTPException) else "the request cannot be read"
        return response("bad_request", str(detail), headers=headers)
    return _unexpected(request, error)


def _disconnected(_request: Request, _error: Exception) -> Response:
    return response("incomplete_body", "the connection ended within the body; nothing was kept")


def _unexpected(request: Request, error: Exception) -> Response:
    instance = uuid4().urn
    log.error("%s %r failed, %s", request.method, request.url.path, instance, exc_info=error)
    return response(
        "internal",
        "the service failed on this request; its log says why under this instance",
        instance=instance,
    )
