"""Query parameters that no route knows are refused: one that is misspelt would otherwise silently give all.

What a route knows is what the OpenAPI document says of it, so that there is one list of it.
"""

from __future__ import annotations

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError

_Known = dict[tuple[str, str], frozenset[str]]  #: names by method and path of a route


async def refuse_unknown(request: Request) -> None:
    """Refuse a request with a query parameter that its route does not know; every route depends on this.

    Raises RequestValidationError, with one entry for each such name.
    """
    given = list(dict.fromkeys(request.query_params))
    if not given:
        return
    known = await run_in_threadpool(_known_of, request)
    errors = [
        {"type": "unknown_parameter", "loc": ("query", name), "msg": _sentence(known), "input": value}
        for name, value in ((name, request.query_params[name]) for name in given if name not in known)
    ]
    if errors:
        raise RequestValidationError(errors)


def _sentence(known: frozenset[str]) -> str:
    if not known:
        return "there is no such parameter; this call has none"
    return f"there is no such parameter; this call has {', '.join(sorted(known))}"


def _known_of(request: Request) -> frozenset[str]:
    app: FastAPI = request.app
    table: _Known | None = getattr(app.state, "known_query", None)
    if table is None:
        table = app.state.known_query = known_parameters(app)
    method = "GET" if request.method == "HEAD" else request.method
    return table.get((method, request.scope["route"].path), frozenset())


def known_parameters(app: FastAPI) -> _Known:
    """Return the names of the query parameters of each route, by its method and path."""
    return {
        (method.upper(), path): frozenset(
            parameter["name"] for parameter in operation.get("parameters", ()) if parameter["in"] == "query"
        )
        for path, operations in app.openapi()["paths"].items()
        for method, operation in operations.items()
    }
