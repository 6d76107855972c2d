"""Schemas of OGC API - Processes - Part 1: Core 1.0 (OGC 18-062r2), written by hand from the standard."""

from __future__ import annotations

from typing import Any

EXCEPTIONS = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0"
RELATIONS = "http://www.opengis.net/def/rel/ogc/1.0"

TEXT = {"type": "string"}
TIME = {"type": "string", "format": "date-time"}
COUNT = {"type": "integer", "minimum": 0}

LINK: dict[str, Any] = {
    "type": "object",
    "required": ["href"],
    "properties": dict.fromkeys(("href", "rel", "type", "hreflang", "title"), TEXT),
}
LINKS = {"type": "array", "items": LINK}

LANDING_PAGE = {
    "type": "object",
    "required": ["links"],
    "properties": {"title": TEXT, "description": TEXT, "links": LINKS},
}

CONF_CLASSES = {
    "type": "object",
    "required": ["conformsTo"],
    "properties": {"conformsTo": {"type": "array", "items": TEXT}},
}

EXCEPTION = {
    "type": "object",
    "required": ["type"],
    "properties": {
        "type": TEXT,
        "title": TEXT,
        "status": {"type": "integer"},
        "detail": TEXT,
        "instance": TEXT,
    },
}

_DESCRIPTION: dict[str, Any] = {
    "title": TEXT,
    "description": TEXT,
    "keywords": {"type": "array", "items": TEXT},
    "metadata": {"type": "array"},
}

PROCESS_SUMMARY: dict[str, Any] = {
    "type": "object",
    "required": ["id", "version"],
    "properties": {
        **_DESCRIPTION,
        "id": TEXT,
        "version": TEXT,
        "jobControlOptions": {
            "type": "array",
            "items": {"enum": ["sync-execute", "async-execute", "dismiss"]},
        },
        "outputTransmission": {"type": "array", "items": {"enum": ["value", "reference"]}},
        "links": LINKS,
    },
}

PROCESS_LIST = {
    "type": "object",
    "required": ["processes", "links"],
    "properties": {"processes": {"type": "array", "items": PROCESS_SUMMARY}, "links": LINKS},
}

_SCHEMA = {"$ref": "https://json-schema.org/draft/2020-12/schema"}
_INPUT = {
    "type": "object",
    "required": ["schema"],
    "properties": {
        **_DESCRIPTION,
        "minOccurs": COUNT,
        "maxOccurs": {"oneOf": [{"type": "integer"}, {"const": "unbounded"}]},
        "schema": _SCHEMA,
    },
}
_OUTPUT = {"type": "object", "required": ["schema"], "properties": {**_DESCRIPTION, "schema": _SCHEMA}}

PROCESS = {
    "allOf": [
        PROCESS_SUMMARY,
        {
            "properties": {
                "inputs": {"type": "object", "additionalProperties": _INPUT},
                "outputs": {"type": "object", "additionalProperties": _OUTPUT},
            }
        },
    ]
}

STATUS_INFO: dict[str, Any] = {
    "type": "object",
    "required": ["jobID", "status", "type"],
    "properties": {
        "processID": TEXT,
        "type": {"enum": ["process"]},
        "jobID": TEXT,
        "status": {"enum": ["accepted", "running", "successful", "failed", "dismissed"]},
        "message": TEXT,
        "created": TIME,
        "started": TIME,
        "finished": TIME,
        "updated": TIME,
        "progress": {"type": "integer", "minimum": 0, "maximum": 100},
        "links": LINKS,
    },
}

JOB_LIST = {
    "type": "object",
    "required": ["jobs", "links"],
    "properties": {"jobs": {"type": "array", "items": STATUS_INFO}, "links": LINKS},
}

#: Of `inlineOrRefData` the form that is used here: each output by a link.
RESULTS = {"type": "object", "additionalProperties": LINK}
