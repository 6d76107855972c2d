"""The API's description: what FastAPI derives, the bodies that are read by hand, problems as the answer to a bad value.

`python -m service.api.schema` writes openapi/openapi.json; a test fails when that file has drifted.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, Literal

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from service.api.features import TileCollection
from service.api.problems import ProblemDocument
from service.api.requests import (
    AnchorRequest,
    MapRequest,
    ScanRequest,
    SurveyRequest,
    TrainingRequest,
    VersionRequest,
)

FILE = Path("openapi/openapi.json")
_REF = "#/components/schemas/{model}"
_SENT: tuple[type[BaseModel], ...] = (
    ScanRequest,
    MapRequest,
    VersionRequest,
    AnchorRequest,
    SurveyRequest,
    TrainingRequest,
)
_ANSWERED: tuple[type[BaseModel], ...] = (ProblemDocument, TileCollection)
_MODES: tuple[tuple[tuple[type[BaseModel], ...], Literal["validation", "serialization"]], ...] = (
    (_SENT, "validation"),
    (_ANSWERED, "serialization"),
)


def body_of(
    *,
    json: type[BaseModel] | None = None,
    raw: bool = False,
    form: type[BaseModel] | None = None,
    file: str = "file",
) -> dict[str, Any]:
    """The `openapi_extra` of a route that reads its body by hand; `file` is the form field of the file or files."""
    content: dict[str, Any] = {}
    if raw:
        content["application/octet-stream"] = {"schema": {"type": "string", "format": "binary"}}
    if json is not None:
        content["application/json"] = {"schema": {"$ref": _REF.format(model=json.__name__)}}
    if form is not None:
        content["multipart/form-data"] = {"schema": _form(form, file)}
    return {"requestBody": {"required": True, "content": content}}


def _form(form: type[BaseModel], file: str) -> dict[str, Any]:
    binary: dict[str, Any] = {"type": "string", "format": "binary"}
    files = binary if file == "file" else {"type": "array", "items": binary}
    named = {"type": "object", "properties": {file: files}}
    return {"allOf": [{"$ref": _REF.format(model=form.__name__)}, named]}


def describe(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of `app`."""
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title,
            version=app.version,
            summary=app.summary,
            description=app.description,
            routes=app.routes,
            tags=app.openapi_tags,
        )
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for models, mode in _MODES:
            _, found = models_json_schema([(model, mode) for model in models], ref_template=_REF)
            schemas.update(found["$defs"])
        schemas.pop("HTTPValidationError", None)
        schemas.pop("ValidationError", None)
        app.openapi_schema = document
    return app.openapi_schema


def written() -> str:
    """The document as the file holds it."""
    from service.api.app import create_app  # noqa: PLC0415 - app.py needs this file
    from service.settings import Settings  # noqa: PLC0415

    return json.dumps(describe(create_app(Settings())), indent=2, sort_keys=True, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    FILE.write_text(written(), encoding="utf-8")
    sys.stdout.write(f"{FILE}\n")
