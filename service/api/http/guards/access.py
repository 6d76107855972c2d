"""Who may ask what: each route with the scopes that admit to it, and the API key that a request brings.

A key comes as `Authorization: Bearer spicd_...` (RFC 6750) and in no other way: an address lands in logs. It is needed
where `Settings.requires_key` says so; one that is brought elsewhere counts as well, with its scopes and maps.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from fastapi import Request
from fastapi.concurrency import run_in_threadpool

from service.api.http.dependencies import Provided
from service.catalog.catalog import Catalog
from service.catalog.keys import PREFIX
from service.catalog.records import KeyRecord, Scope
from service.errors import Forbidden, Unauthorized

Scopes = frozenset[Scope]

OPEN: Scopes = frozenset()  #: nobody is asked
_READ: Scopes = frozenset({"changes:read"})
_SCANS: Scopes = frozenset({"scans:write"})
_SURVEYS: Scopes = frozenset({"surveys:write"})
_MAPS: Scopes = frozenset({"maps:write"})

#: Any one of the scopes admits to a route; `admin` admits to all. What makes a thing may look at that thing.
SCOPES: Mapping[tuple[str, str], Scopes] = {
    ("POST", "/scans"): _SCANS,
    ("GET", "/scans"): _READ,
    ("GET", "/scans/{scan_id}"): _READ | _SCANS,
    ("DELETE", "/scans/{scan_id}"): _SCANS,
    ("OPTIONS", "/uploads"): _SCANS,
    ("POST", "/uploads"): _SCANS,
    ("HEAD", "/uploads/{upload_id}"): _SCANS,
    ("GET", "/uploads/{upload_id}"): _SCANS,
    ("PATCH", "/uploads/{upload_id}"): _SCANS,
    ("POST", "/uploads/{upload_id}"): _SCANS,
    ("DELETE", "/uploads/{upload_id}"): _SCANS,
    ("POST", "/maps"): _MAPS,
    ("GET", "/maps"): _READ | _MAPS,
    ("GET", "/maps/{map_id}"): _READ | _MAPS,
    ("DELETE", "/maps/{map_id}"): _MAPS,
    ("GET", "/maps/{map_id}/scans"): _READ | _MAPS,
    ("GET", "/maps/{map_id}/manifest"): _READ,
    ("GET", "/maps/{map_id}/cloud.laz"): _READ,
    ("GET", "/maps/{map_id}/cloud.ply"): _READ,
    ("GET", "/maps/{map_id}/tileset.json"): _READ,
    ("PUT", "/maps/{map_id}/anchor"): _MAPS,
    ("DELETE", "/maps/{map_id}/anchor"): _MAPS,
    ("POST", "/maps/{map_id}/versions"): _MAPS,
    ("GET", "/maps/{map_id}/versions"): _READ | _MAPS,
    ("GET", "/maps/{map_id}/versions/{number}"): _READ | _MAPS,
    ("DELETE", "/maps/{map_id}/versions/{number}"): _MAPS,
    ("GET", "/maps/{map_id}/versions/{number}/scans"): _READ | _MAPS,
    ("GET", "/maps/{map_id}/versions/{number}/manifest"): _READ,
    ("GET", "/maps/{map_id}/versions/{number}/cloud.laz"): _READ,
    ("GET", "/maps/{map_id}/versions/{number}/cloud.ply"): _READ,
    ("GET", "/maps/{map_id}/versions/{number}/tileset.json"): _READ,
    ("GET", "/maps/{map_id}/versions/{number}/tileset/{content}"): _READ,
    ("POST", "/maps/{map_id}/models"): _MAPS,
    ("GET", "/models"): _READ | _MAPS,
    ("GET", "/models/{name}"): _READ | _MAPS,
    ("POST", "/maps/{map_id}/surveys"): _SURVEYS,
    ("GET", "/maps/{map_id}/surveys"): _READ,
    ("GET", "/surveys/{survey_id}"): _READ | _SURVEYS,
    ("DELETE", "/surveys/{survey_id}"): _SURVEYS,
    ("GET", "/surveys/{survey_id}/tiles"): _READ,
    ("GET", "/surveys/{survey_id}/cloud.laz"): _READ,
    ("GET", "/surveys/{survey_id}/cloud.ply"): _READ,
    ("GET", "/surveys/{survey_id}/picture.png"): _READ,
    ("GET", "/surveys/{survey_id}/tileset.json"): _READ,
    ("GET", "/surveys/{survey_id}/tileset/{content}"): _READ,
    ("GET", "/surveys/{survey_id}/objects"): _READ,
    ("GET", "/maps/{map_id}/changes"): _READ,
    ("GET", "/maps/{map_id}/objects"): _READ,
    ("GET", "/maps/{map_id}/objects/{object_id}"): _READ,
    ("GET", "/events"): _READ,  # of the key's maps, where it is bound to some
    ("POST", "/webhooks"): _MAPS,
    ("GET", "/webhooks"): _MAPS,
    ("GET", "/webhooks/{webhook_id}"): _MAPS,
    ("PATCH", "/webhooks/{webhook_id}"): _MAPS,
    ("DELETE", "/webhooks/{webhook_id}"): _MAPS,
    ("POST", "/webhooks/{webhook_id}/ping"): _MAPS,
    ("POST", "/webhooks/{webhook_id}/rotate"): _MAPS,
    ("GET", "/webhooks/{webhook_id}/deliveries"): _MAPS,
    ("POST", "/webhooks/{webhook_id}/deliveries/{delivery_id}/repeat"): _MAPS,
    ("GET", "/jobs"): _READ,
    ("GET", "/jobs/{job_id}"): _READ | _SURVEYS | _MAPS,
    ("GET", "/jobs/{job_id}/results"): _READ | _SURVEYS | _MAPS,
    ("DELETE", "/jobs/{job_id}"): _SURVEYS | _MAPS,  # of which one, by the kind of the job
    ("POST", "/jobs/{job_id}/retry"): _SURVEYS | _MAPS,  # the same
    ("GET", "/"): OPEN,
    ("GET", "/conformance"): OPEN,
    ("GET", "/processes"): OPEN,
    ("GET", "/processes/{process_id}"): OPEN,
    ("GET", "/health/live"): OPEN,
    ("GET", "/health/ready"): OPEN,
    ("GET", "/metrics"): _READ,
}

#: They tell of every map, so that a key which is bound to maps is refused. Lists of maps, jobs and models are filtered.
OF_ALL_MAPS = frozenset({("GET", "/scans"), ("GET", "/metrics")})

_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")


async def authorize(request: Request, services: Provided) -> None:
    """Admit a request to its route, before anything of it is read; every route depends on this.

    Leaves the key's id in `request.state.key` and the maps that it is bound to in `request.state.maps`, or None and
    None. Raises Unauthorized and Forbidden, and NotFound for a survey or job that is none.
    """
    request.state.key = request.state.maps = None
    route = (request.method, request.scope["route"].path)
    scopes = SCOPES.get(route)
    if scopes is None:
        raise Forbidden(f"{' '.join(route)} is in no list of who may ask it, so nobody may")
    secret = None if scopes == OPEN else _secret(request, required=services.settings.requires_key())
    if secret is not None:
        key = await run_in_threadpool(_admitted, services.catalog, secret, route, request.path_params)
        request.state.key, request.state.maps = key.key_id, key.maps


def maps_of_key(request: Request) -> tuple[str, ...] | None:
    """Return the ids of the maps that the request's key is bound to; None: all, or there is no key."""
    maps: tuple[str, ...] | None = getattr(request.state, "maps", None)
    return maps


def require_map(request: Request, map_id: str | None) -> None:
    """Raise Forbidden where the request's key is bound to maps, and `map_id`, which a body names, is none of them."""
    maps = maps_of_key(request)
    if maps is not None and map_id not in maps:
        raise Forbidden(f"the key is bound to {_listed(maps)}; give the map one of these as its `id`")


def secured(document: dict[str, Any], unauthorized: dict[int | str, Any]) -> None:
    """Write into an OpenAPI document which operations take a key, with which scopes, and how they refuse."""
    schemes = document.setdefault("components", {}).setdefault("securitySchemes", {})
    schemes["key"] = {
        "type": "http",
        "scheme": "bearer",
        "description": "An API key, made by `spicd keys add`",
    }
    for (method, path), scopes in SCOPES.items():
        operation = document.get("paths", {}).get(path, {}).get(method.lower())
        if operation is None:
            continue
        operation["security"] = [{"key": [scope]} for scope in sorted(scopes)]
        if scopes != OPEN:
            for status, answer in unauthorized.items():
                operation["responses"].setdefault(str(status), answer)


def _secret(request: Request, *, required: bool) -> str | None:
    """Return the secret that a request brings; None where it brings none and needs none. Raises Unauthorized.

    Where none is needed, other credentials are those of something in front, and are not ours to judge.
    """
    scheme, _, secret = request.headers.get("authorization", "").partition(" ")
    secret = secret.strip()
    if scheme.lower() == "bearer" and (required or secret.startswith(PREFIX)):
        return secret
    if required:
        raise Unauthorized("the request brings no API key; send it as `Authorization: Bearer spicd_...`")
    return None


def _admitted(
    catalog: Catalog, secret: str, route: tuple[str, str], path_params: Mapping[str, Any]
) -> KeyRecord:
    """Return the key of a secret if it may ask this. Raises Unauthorized, Forbidden and NotFound."""
    key = catalog.keys.find(secret)
    if key is None:
        raise Unauthorized("the API key is not known, has expired or was revoked")
    scopes = SCOPES[route]
    ids = {
        name: value for name, value in path_params.items() if _ID.fullmatch(str(value))
    }  # others are a 422
    changes_job = route in (("DELETE", "/jobs/{job_id}"), ("POST", "/jobs/{job_id}/retry"))
    if key.may(scopes) and changes_job and "job_id" in ids:
        scopes = _SURVEYS if catalog.jobs.get(ids["job_id"]).kind == "survey" else _MAPS
    if not key.may(scopes):
        raise Forbidden(f"key {key.key_id!r} has not the scope {' or '.join(sorted(scopes))} that this needs")
    if key.maps is not None:
        _check_maps(catalog, key, key.maps, route, ids)
    return key


def _check_maps(
    catalog: Catalog,
    key: KeyRecord,
    maps: tuple[str, ...],
    route: tuple[str, str],
    ids: Mapping[str, str],
) -> None:
    """Raise Forbidden where a route is about a map that the key is not bound to."""
    if route in OF_ALL_MAPS:
        raise Forbidden(f"key {key.key_id!r} is bound to {_listed(maps)}, and this tells of every map")
    map_id = ids.get("map_id")
    if "survey_id" in ids:
        map_id = catalog.surveys.get(ids["survey_id"]).map_id
    elif "job_id" in ids:
        map_id = catalog.jobs.get(ids["job_id"]).map_id
    elif "webhook_id" in ids:  # one of no map in particular is none of theirs
        map_id = catalog.webhooks.get(ids["webhook_id"]).map_id or ""
    if map_id is not None and map_id not in maps:
        raise Forbidden(f"key {key.key_id!r} is bound to {_listed(maps)}, and this is of another map")


def _listed(maps: tuple[str, ...]) -> str:
    return f"the map{'s' if len(maps) > 1 else ''} {', '.join(maps)}"
