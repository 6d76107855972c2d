"""The bases of what clients send and get, links, and how values of a request are checked."""

from __future__ import annotations

from typing import Any, TypeVar

from fastapi import Request as HttpRequest
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

R = TypeVar("R", bound=BaseModel)


class Request(BaseModel):
    """Base of every request: a name that is not known is a mistake worth telling."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Document(BaseModel):
    """Base of every document; one that shows a record has the record's class as its first base."""

    model_config = ConfigDict(extra="ignore", frozen=True, json_schema_serialization_defaults_required=True)


class Link(Document):
    """Where to go on (RFC 8288); `href` is a path on this host."""

    href: str = Field(examples=["/jobs/job-5f0c"])
    rel: str = Field(examples=["self"])
    type: str = "application/json"


def link(request: HttpRequest, path: str, rel: str, media_type: str = "application/json") -> Link:
    """Return a link to a path of this API, wherever it is mounted."""
    return Link(href=request.scope.get("root_path", "") + path, rel=rel, type=media_type)


def checked(kind: type[R], fields: dict[str, Any], *, place: str = "body") -> R:
    """Return the request in these fields. Raises RequestValidationError, which the API answers as FastAPI's own."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        errors = [
            {**entry, "loc": (place, *entry["loc"]), "msg": _sentence(kind, entry)}
            for entry in error.errors(include_url=False, include_context=False)
        ]
        raise RequestValidationError(errors) from error


def _sentence(kind: type[BaseModel], error: ErrorDetails) -> str:
    """Say what is wrong; where the name of a field is not known, those that are."""
    if error["type"] != "extra_forbidden":
        return error["msg"]
    if len(error["loc"]) > 1:
        return "there is no such field"
    return f"there is no such field; there are {', '.join(sorted(kind.model_fields))}"
