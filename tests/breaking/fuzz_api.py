"""Sends requests of every kind to the API within this process: `python -m tests.breaking.fuzz_api`.

The app has a real catalog (SQLite and files in a temporary folder) and a queue that only remembers. Exit status 1 for a
status that the OpenAPI document does not name for that operation, for one over 499 but a documented 503, for an answer
that is no problem document, for over 2 s, and where the process grows past 1 GB. Every 2,000 cases share a catalog.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import gzip
import json
import logging
import random
import re
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import unquote

from fastapi import FastAPI

from service.api.app import create_app
from service.catalog.catalog import Catalog
from service.catalog.findings.objects import ObjectFilter
from tests.breaking.requests import Request, Requests
from tests.support.findings import Deadline, Findings, add_common, show
from tests.support.footprints import peak_resident
from tests.support.samples import (
    NOON,
    RememberingQueue,
    add_map,
    add_scan,
    add_survey,
    add_version,
    place,
    settings_in,
    thing,
    tile,
)

HANG_S = 2.0
MEMORY = 1024**3  #: bytes that this process may take
_BATCH = 2_000  # cases on one catalog; then all is made anew
_NO_OPERATION = {404, 405, 307}  # of a path or a method that the document does not have


@dataclass
class Answer:
    """What the app answered."""

    status: int | None = None  #: None: nothing, as where the connection ended
    headers: dict[str, str] = field(default_factory=dict)
    body: bytearray = field(default_factory=bytearray)
    operation: tuple[str, str] | None = None  #: method and template of the path that it came to


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    options = _parse(arguments)
    logging.disable(logging.WARNING)
    deadline, found = Deadline(options.minutes), Findings()
    for start in range(options.first - options.first % _BATCH, options.cases, _BATCH):
        if deadline.over():
            break
        found.merge(asyncio.run(run_batch(options.seed, start, min(start + _BATCH, options.cases))))
        print(f"{found.cases:,} cases, {sum(found.counts.values())} findings", file=sys.stderr)
        gc.collect()
    taken = peak_resident()
    if taken > MEMORY:
        found.add("memory", f"{taken / 1e6:.0f} MB at the peak")
    seconds = deadline.passed_s()
    rows: dict[str, object] = {
        "requests": f"{found.cases:,} in {seconds:.0f} s ({found.cases / max(seconds, 1e-9):,.0f} a second)",
        "statuses": ", ".join(f"{status} {count:,}" for status, count in sorted(found.outcomes.items())),
        **{
            kind: found.counts[kind]
            for kind in ("undocumented", "5xx", "hang", "memory", "no problem document")
        },
        "slowest": f"{1000 * found.slowest_s:.0f} ms",
        "memory at the peak": f"{taken / 1e6:.0f} MB",
    }
    show(rows, found.document(seconds=round(seconds, 1), peak_bytes=taken, seed=options.seed), options.json)
    for kind, words in found.kept.items():
        print("\n".join(f"{kind}: {line}" for line in words))
    return 1 if found.counts else 0


async def run_batch(seed: int, start: int, stop: int) -> Findings:
    """Send the cases [start, stop) to a new service."""
    found, errors = Findings(), _LastError()
    logging.getLogger().addHandler(errors)
    queue = RememberingQueue()
    try:
        async with service(queue) as app:
            document = app.openapi()
            requests = Requests(document, things(app.state.services.catalog))
            for i in range(start, stop):
                rng = random.Random((seed << 40) + i)
                queue.down = rng.random() < 0.01
                request = requests.make(rng)
                await _one(app, document, request, requests, found, f"case {i}: {request.words()}", errors)
    finally:
        logging.getLogger().removeHandler(errors)
    return found


async def _one(
    app: FastAPI,
    document: dict[str, Any],
    request: Request,
    requests: Requests,
    found: Findings,
    words: str,
    errors: _LastError,
) -> None:
    errors.text = ""
    begun = time.perf_counter()
    answer = await asked(app, request)
    seconds = time.perf_counter() - begun
    if seconds > HANG_S:  # a busy machine is no hang: it has to be one twice
        begun = time.perf_counter()
        await asked(app, request)
        seconds = min(seconds, time.perf_counter() - begun)
    asked_s = re.findall(r"(?:^|&)wait=(\d{1,2})(?=&|$)", request.query)
    seconds -= float(asked_s[-1]) if asked_s else 0.0  # GET /events waits for as long as it is told to last
    found.cases += 1
    found.outcomes[str(answer.status)] += 1
    found.slowest_s = max(found.slowest_s, seconds)
    wrong = wrongs(answer, request, document)
    wrong += [("hang", f"{seconds:.1f} s")] if seconds > HANG_S else []
    for kind, why in wrong:
        found.add(kind, f"{why}, {words} {errors.text}")
        print(f"{kind}: {why}, {words} {errors.text}", file=sys.stderr)
    match = re.search(rb'[?&]cursor=([^&"#]+)', bytes(answer.body[-100_000:]))
    if match and len(requests.cursors) < 50:
        requests.cursors.append(unquote(match.group(1).decode()))


def wrongs(answer: Answer, request: Request, document: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what must not be about an answer: kind and words."""
    if answer.status is None:
        return [] if request.breaks_off else [("5xx", "no answer")]
    allowed = _NO_OPERATION
    if request.method == "OPTIONS" and answer.operation is None:
        allowed = {204, 404}
    elif answer.operation is not None:
        method, path = answer.operation
        operations = document["paths"].get(path, {})
        if method == "HEAD" and "head" not in operations:  # the same as GET without its content
            method = "GET"
        operation = operations.get(method.lower())
        allowed = {int(status) for status in operation["responses"]} if operation else _NO_OPERATION
    found = []
    if answer.status >= 500 and not (answer.status == 503 and 503 in allowed):
        found.append(("5xx", str(answer.status)))
    elif answer.status not in allowed:
        found.append(("undocumented", f"{answer.status} of {sorted(allowed)}"))
    if answer.status >= 400 and request.method != "HEAD" and not _is_problem(answer):
        found.append(("no problem document", str(answer.status)))
    return found


def _is_problem(answer: Answer) -> bool:
    body = bytes(answer.body)
    try:
        if answer.headers.get("content-encoding") == "gzip":
            body = gzip.decompress(body)
        return {"type", "title", "detail"} <= json.loads(body).keys()
    except (ValueError, AttributeError):
        return False


async def asked(app: FastAPI, request: Request) -> Answer:
    """Send a request as a server would, and return the answer."""
    answer = Answer()
    half = len(request.body) // 2
    pieces = [request.body[:half], request.body[half:]]
    waiting = [{"type": "http.request", "body": pieces[0], "more_body": True}]
    if not request.breaks_off:
        waiting.append({"type": "http.request", "body": pieces[1], "more_body": False})

    leaves = asyncio.Event()  # a stream of events would never end, so its reader leaves once it began
    if request.breaks_off:
        leaves.set()

    async def receive() -> dict[str, Any]:
        if waiting:
            return waiting.pop(0)
        await leaves.wait()
        return {"type": "http.disconnect"}

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            answer.status = message["status"]
            answer.headers = {
                key.decode("latin-1").lower(): value.decode("latin-1") for key, value in message["headers"]
            }
            if answer.headers.get("content-type", "").startswith("text/event-stream"):
                leaves.set()
        elif message["type"] == "http.response.body":
            answer.body += message.get("body", b"")

    scope = _scope(request)
    try:
        await app(scope, receive, send)  # type: ignore[arg-type]
    except Exception as error:  # what the app answered with 500 is raised again for the server to log
        logging.getLogger("fuzz").error("%s", error, exc_info=error)
    route = scope.get("route")
    if route is not None:
        answer.operation = (request.method, route.path_format)
    return answer


def _scope(request: Request) -> dict[str, Any]:
    return {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "method": request.method,
        "scheme": "http",
        "path": unquote(request.path),
        "raw_path": request.path.encode("ascii"),
        "query_string": request.query.encode("ascii"),
        "root_path": "",
        "headers": list(request.headers),
        "client": ("127.0.0.1", 50_000),
        "server": ("127.0.0.1", 8000),
        "state": {},
    }


@asynccontextmanager
async def service(queue: RememberingQueue) -> AsyncIterator[FastAPI]:
    """Give an app with some of everything in its catalog."""
    with TemporaryDirectory(prefix="spicd-fuzz-") as folder:
        app = create_app(settings_in(Path(folder)), queue=queue)
        async with app.router.lifespan_context(app):
            fill(app.state.services.catalog)
            yield app


def fill(catalog: Catalog) -> None:
    """Put scans, maps in several states, versions, surveys with tiles and objects, and jobs into a catalog."""
    for name in ("one", "two", "three"):
        add_scan(catalog, name)
    for map_id in ("lobby", "hall", "yard"):
        add_map(catalog, map_id)
    add_map(catalog, "building", ready=False)
    add_version(catalog, "lobby")
    tiles = [
        tile(i, j, ("changed", "unchanged", "unobserved")[(i + j) % 3], 0.3 + 0.1 * i)
        for i in range(6)
        for j in range(4)
    ]
    for day in range(3):
        objects = [
            thing(1, now=place(1, 1)),
            thing(2, before=place(3, 2)),
            thing(3, now=place(5, 1), before=place(4, 1)),
        ]
        add_survey(catalog, tiles, captured_at=NOON + timedelta(days=day), objects=objects, moving=day)
    add_survey(catalog, [tile(0, 0)], map_id="hall")
    add_survey(catalog, map_id="lobby", captured_at=NOON + timedelta(days=9), ready=False)


def things(catalog: Catalog) -> dict[str, list[str]]:
    """Return the ids of what is in a catalog, by the names of parameters and fields."""
    maps = [record.map_id for record in catalog.maps.page().items]
    surveys = [record.survey_id for map_id in maps for record in catalog.surveys.page(map_id).items]
    objects = [each.object_id for each in catalog.objects.page(ObjectFilter(map_id="lobby")).items]
    return {
        "map_id": [*maps, "nowhere"],
        "survey_id": [*surveys, "none"],
        "scan_id": [record.scan_id for record in catalog.scans.page().items] + ["none"],
        "job_id": [record.job_id for record in catalog.jobs.page().items] + ["none"],
        "object_id": [*objects, "none"],
        "number": ["1", "2", "3", "99"],
        "content": ["5f0c91b64f2e7a08-0-64.glb", "none"],
        "name": ["spicd-net/1", "no-such/1"],
        "model": ["spicd-net/1", "no-such/1"],
        "process_id": ["map", "survey", "none"],
        "upload_id": [32 * "0", "none"],
        "webhook_id": ["webhook-1", "none"],
        "delivery_id": ["delivery-1", "none"],
    }


class _LastError(logging.Handler):
    """Keeps the place of the last error that was logged with its exception."""

    text = ""

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and record.exc_info[1] is not None:
            error, where = record.exc_info[1], record.exc_info[2]
            while where is not None and where.tb_next is not None:
                where = where.tb_next
            line = f"{where.tb_frame.f_code.co_filename}:{where.tb_lineno}" if where else ""
            self.text = f"[{type(error).__name__}: {str(error)[:200]} at {line}]"


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.fuzz_api", description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000, help="requests")
    parser.add_argument(
        "--first", type=int, default=0, metavar="CASE", help="begin with the batch of this case"
    )
    add_common(parser, minutes=15)
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
