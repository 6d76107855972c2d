"""The OpenAPI document where FastAPI's own says what does not hold, or what generators of clients trip over."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from fastapi.routing import APIRoute

Schema = dict[str, Any]  #: JSON Schema (draft 2020-12), as OpenAPI 3.1 has it

_SCHEMAS = "#/components/schemas/"

#: Of ids, by the names that parameters and fields have.
_EXAMPLES = {
    "scan_id": "scan-2b1f",
    "survey_id": "survey-91c4",
    "survey": "survey-91c4",
    "change": "change-5c02",
    "change_id": "change-5c02",
    "object_id": "object-77aa",
    "job_id": "job-5f0c",
    "webhook_id": "webhook-2d7e",
    "delivery_id": "delivery-88a0",
}


def operation_id(route: APIRoute) -> str:
    """Return the id of an operation, which names a function of each generated client: that of ours."""
    return route.name


def mended(document: dict[str, Any]) -> dict[str, Any]:
    """Return an OpenAPI document that admits what the service takes, and no more; the one that is given changes."""
    for operation in operations(document):
        for parameter in operation.get("parameters", ()):
            parameter["schema"] = not_null(parameter["schema"])
            _say_bounds(parameter)
            _give_example(parameter["name"], parameter["schema"])
        for answer in operation["responses"].values():
            _mend_answer(answer)
    sent = _only_sent(document)
    for schema in sent:
        _leave_out_defaults(schema)
    _name_forms(document)
    for schema in document["components"]["schemas"].values():
        if not any(schema is one for one in sent):
            _leave_out_nulls(schema)
        for name, field in schema.get("properties", {}).items():
            for option in (field, *field.get("anyOf", ())):
                _give_example(name, option)
    _join_equal_items(document)
    return document


def operations(document: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield each operation of a document."""
    for methods in document["paths"].values():
        yield from methods.values()


def not_null(schema: Schema) -> Schema:
    """Return a schema without null: parameters and fields of forms are left out, never null."""
    options = [option for option in schema.get("anyOf", ()) if option.get("type") != "null"]
    if len(options) != 1:
        return schema
    rest = {name: value for name, value in schema.items() if name != "anyOf"}
    return {**options[0], **{name: value for name, value in rest.items() if value is not None}}


def schemas_under(node: Any, document: dict[str, Any]) -> dict[str, Schema]:
    """Return the named schemas that a part of the document leads to, by their names."""
    found: dict[str, Schema] = {}
    waiting = [node]
    while waiting:
        part = waiting.pop()
        if isinstance(part, list):
            waiting += part
        elif isinstance(part, dict):
            waiting += part.values()
            name = str(part.get("$ref", "")).removeprefix(_SCHEMAS)
            if name and name not in found:
                found[name] = document["components"]["schemas"][name]
                waiting.append(found[name])
    return found


def _mend_answer(answer: dict[str, Any]) -> None:
    """Drop the type that FastAPI supposes of an answer which is written by hand, beside the schema that it has."""
    for content in answer.get("content", {}).values():
        if "$ref" in content.get("schema", {}):
            content["schema"].pop("type", None)


def _give_example(name: str, schema: Schema) -> None:
    """Give an id that is none of a map an example of its own sort."""
    example = _EXAMPLES.get(name)
    if example is not None and "examples" in schema:
        schema["examples"] = [example]


def _say_bounds(parameter: dict[str, Any]) -> None:
    """Say in words between which numbers a parameter lies and what it is where it is left out.

    Generators of TypeScript show the description of a parameter, and nothing of the numbers in its schema.
    """
    schema = parameter["schema"]
    least, most, default = (schema.get(name) for name in ("minimum", "maximum", "default"))
    said = [parameter["description"]] if "description" in parameter else []
    if least is not None and most is not None:
        said.append(f"{least:g} to {most:g}")
    elif least is not None:
        said.append(f"at least {least:g}")
    if isinstance(default, bool | int | float | str) and "left out" not in " ".join(said):
        said.append(f"left out: {json.dumps(default) if isinstance(default, bool) else default}")
    if said:
        parameter["description"] = "; ".join(said)


def _leave_out_nulls(schema: Schema) -> None:
    """Describe what an answer leaves out where it has none as that, and not as null; no null is a default."""
    for name, field in schema.get("properties", {}).items():
        if "default" in field and field["default"] is None:
            del field["default"]
            if name not in schema.get("required", ()):
                schema["properties"][name] = not_null(field)


def _only_sent(document: dict[str, Any]) -> list[Schema]:
    """Return the schemas that stand in bodies of requests alone, named or not."""
    bodies = [operation["requestBody"] for operation in operations(document) if "requestBody" in operation]
    answers = schemas_under([operation["responses"] for operation in operations(document)], document)
    named = [schema for name, schema in schemas_under(bodies, document).items() if name not in answers]
    return named + [content["schema"] for body in bodies for content in body["content"].values()]


def _leave_out_defaults(schema: Schema) -> None:
    """Say a property's default in words: generators of TypeScript take what has a default for always there."""
    for field in schema.get("properties", {}).values():
        default = field.pop("default", None)
        if isinstance(default, int | float | str):
            said = field.get("description")
            field["description"] = f"{said}; left out: {default}" if said else f"left out: {default}"


def _join_equal_items(node: Any) -> None:
    """Describe a row of equal members, such as a matrix or a point, as a list of that length.

    Tuples of sixteen numbers, each with a schema of its own, are more than some programs follow.
    """
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        _join_equal_items(child)
    members = node.get("prefixItems", []) if isinstance(node, dict) else []
    if members and isinstance(members, list) and all(member == members[0] for member in members):
        node["items"] = node.pop("prefixItems")[0]


def _name_forms(document: dict[str, Any]) -> None:
    """Give schemas of bodies that stand in an operation a name of their own, by which generators call them."""
    for operation in operations(document):
        for content in operation.get("requestBody", {}).get("content", {}).values():
            if "title" in content["schema"]:
                schema = content["schema"]
                document["components"]["schemas"][schema["title"]] = schema
                content["schema"] = {"$ref": _SCHEMAS + schema["title"]}
