"""Holds a running API against its OpenAPI document with schemathesis: `python -m tests.breaking.contract`.

The service listens on a port, has some of everything in its catalog, wants a key, and its queue only remembers, so that
no worker is needed. Exit status 1 for any failure of a check. What is asked is in tests/tools/schemathesis.toml.
"""

from __future__ import annotations

import argparse
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import uvicorn
from fastapi import FastAPI

from service.api.app import create_app
from service.catalog.catalog import Catalog
from tests.breaking.fuzz_api import fill, things
from tests.support.samples import NOON, RememberingQueue, add_map, add_survey, settings_in, tile
from tests.support.tools import TESTS, TOOLS

PHASES = ("examples", "coverage", "fuzzing", "stateful")
SPARE = 40  #: maps, and surveys, that are there to be deleted
_STARTS_S = 30


@dataclass(frozen=True)
class Contract:
    """An API that listens, and what is asked about."""

    url: str
    key: str
    ids: Mapping[str, Sequence[str]]  #: that exist, by the name of their dictionary


@contextmanager
def serving(folder: Path) -> Iterator[Contract]:
    """Serve an API of its own while the block lasts."""
    settings = settings_in(folder).model_copy(
        update={"auth": "required", "max_waiting_jobs": 10**9, "max_waiting_jobs_per_device": 10**9}
    )
    app = create_app(settings, queue=RememberingQueue())
    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = uvicorn.Server(uvicorn.Config(app, log_config=None, access_log=False, server_header=False))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        until = time.monotonic() + _STARTS_S
        while not server.started:
            assert thread.is_alive() and time.monotonic() < until, "the API did not start"
            time.sleep(0.02)
        try:
            yield _contract(app, f"http://127.0.0.1:{listening.getsockname()[1]}")
        finally:
            server.should_exit = True
            thread.join(10)


def _contract(app: FastAPI, url: str) -> Contract:
    catalog: Catalog = app.state.services.catalog
    fill(catalog)
    ids = {
        name: [one for one in found if one not in ("none", "nowhere")]
        for name, found in things(catalog).items()
    }
    ids["spare_map_id"] = [f"spare-{number}" for number in range(SPARE)]
    for map_id in ids["spare_map_id"]:
        add_map(catalog, map_id)
    times = [NOON + timedelta(days=100 + number) for number in range(SPARE)]
    ids["spare_survey_id"] = [
        add_survey(catalog, [tile(0, 0)], map_id="yard", captured_at=when)[0] for when in times
    ]
    return Contract(url=url, key=catalog.keys.add("contract", scopes=["admin"])[1], ids=ids)


def check(contract: Contract, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run schemathesis against the API with further options; its report is what it prints."""
    for name, ids in contract.ids.items():
        (folder / f"{name}.txt").write_text("".join(f'"{one}"\n' for one in ids))
    config = folder / "schemathesis.toml"  # beside its dictionaries
    config.write_text((TESTS / "schemathesis.toml").read_text())
    command = [str(TOOLS / "bin" / "schemathesis"), "--config-file", str(config), "run"]
    command += [f"{contract.url}/openapi.json", "--header", f"Authorization: Bearer {contract.key}", *words]
    environment = {**os.environ, "PYTHONPATH": str(TESTS), "NO_COLOR": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def main(arguments: list[str] | None = None) -> int:
    """Run as told; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.breaking.contract", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10, help="of fuzzing and stateful testing together")
    parser.add_argument("--examples", type=int, default=100, help="of each operation at most")
    parser.add_argument("--seed", type=int, default=1, help="the same seed gives the same requests")
    parser.add_argument("--phases", default=",".join(PHASES), help="with commas between")
    options, more = parser.parse_known_args(arguments)  # further ones are schemathesis's
    logging.disable(logging.WARNING)
    with TemporaryDirectory(prefix="spicd-contract-") as folder, serving(Path(folder)) as contract:
        words = ["--max-time", str(round(60 * options.minutes)), "--max-examples", str(options.examples)]
        words += ["--seed", str(options.seed), "--phases", options.phases, *more]
        done = check(contract, Path(folder), *words)
    print(done.stdout + done.stderr)
    return 1 if done.returncode else 0


if __name__ == "__main__":
    sys.exit(main())
