"""A service of real processes, and a room that was scanned twice."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from worker.cloud.formats.pcd import write_pcd
from worker.simulation.scenes import corridor, random_room
from worker.simulation.scenes.furniture import crate
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import stops, visit

ROOT = Path(__file__).parents[2]
MODEL = "spicd-net/1"
STARTS_WITHIN_S, ENDS_WITHIN_S, JOB_WITHIN_S = 60, 20, 120
ORDER = ("accepted", "running", "successful", "failed", "dismissed")


@pytest.fixture(scope="session")
def model_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's models; where the weights are not there, a network that was never trained."""
    shipped = ROOT / "model_store"
    if (shipped / MODEL / "card.json").exists():
        return shipped
    store = tmp_path_factory.mktemp("models")
    make_untrained(store / MODEL)
    return store


def make_untrained(folder: Path) -> None:
    """A model that knows nothing, in `model_store/<name>/<version>`."""
    import torch
    from safetensors.torch import save

    from worker.detectors.card import Card, Preprocessing
    from worker.detectors.spicd_net.network import SpicdNetwork

    torch.manual_seed(0)
    weights = save(SpicdNetwork().state_dict())
    card = Card(
        name="spicd-net",
        version="1",
        detector="spicd-net",
        summary="never trained",
        threshold=0.4,
        preprocessing=Preprocessing(voxel_size=0.05, tile_size=(1.5, 1.5, 1.0), min_points=512),
        detector_settings={"patch_points": 4096, "seed": 42},
        weights="weights.safetensors",
        sha256=hashlib.sha256(weights).hexdigest(),
    )
    folder.mkdir(parents=True)
    (folder / "weights.safetensors").write_bytes(weights)
    (folder / "card.json").write_text(card.model_dump_json())


class Service:
    """`spicd up`, and its API as a client sees it."""

    def __init__(self, folder: Path, model_store: Path) -> None:
        ready, self.log = folder / "ready.json", folder / "log"
        command = [sys.executable, "-m", "service", "up", "--port", "0", "--end-with-parent"]
        command += ["--data-dir", str(folder / "data"), "--ready-file", str(ready)]
        environment = {key: value for key, value in os.environ.items() if not key.startswith("SPICD_")}
        environment["SPICD_MODEL_STORE"] = str(model_store)
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
        until = time.monotonic() + STARTS_WITHIN_S
        while not ready.exists():
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < until, self.log.read_text()
            time.sleep(0.05)
        self.http = httpx.Client(base_url=json.loads(ready.read_text())["url"], timeout=30)

    def get(self, path: str) -> Any:
        answer = self.http.get(path)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def upload(self, path: Path, **about: str) -> str:
        """As a raw body; the scan's id."""
        answer = self.http.post(
            "/scans",
            params={"filename": path.name, **about},
            content=path.read_bytes(),
            headers={"Content-Type": "application/octet-stream"},
        )
        assert answer.status_code == 201, answer.text
        return str(answer.json()["scan_id"])

    def post(self, path: str, *files: Path, **body: Any) -> dict[str, Any]:
        """JSON, or a form with `scans`; the 202 answer."""
        scans = [("scans", (file.name, file.read_bytes())) for file in files]
        answer = self.http.post(path, data=body, files=scans) if files else self.http.post(path, json=body)
        assert answer.status_code == 202, answer.text
        accepted: dict[str, Any] = answer.json()
        assert answer.headers["Location"] == f"/jobs/{accepted['job_id']}"
        return accepted

    def ended(self, job_id: str) -> dict[str, Any]:
        """The job's last document; on the way states only move forward, and progress never falls."""
        seen: list[dict[str, Any]] = []
        until = time.monotonic() + JOB_WITHIN_S
        while not seen or seen[-1]["status"] in ("accepted", "running"):
            assert time.monotonic() < until, f"{seen[-1]}\n{self.log.read_text()[-4000:]}"
            seen.append(self.get(f"/jobs/{job_id}"))
            time.sleep(0.05)
        states = [ORDER.index(job["status"]) for job in seen]
        progress = [job["progress"] for job in seen]
        assert states == sorted(states)
        assert progress == sorted(progress)
        return seen[-1]

    def succeeded(self, job_id: str) -> dict[str, Any]:
        job = self.ended(job_id)
        assert job["status"] == "successful", f"{job}\n{self.log.read_text()[-4000:]}"
        assert job["progress"] == 100
        return job

    def processes(self) -> set[int]:
        """The service and everything that it started."""
        return {self.process.pid, *_descendants(self.process.pid)}

    def end(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(ENDS_WITHIN_S)


def _descendants(pid: int) -> Iterator[int]:
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            yield child
            yield from _descendants(child)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, model_store: Path) -> Iterator[Service]:
    service = Service(tmp_path_factory.mktemp("service"), model_store)
    yield service
    if service.process.poll() is None:
        service.end()


@dataclass(frozen=True, kw_only=True)
class Visits:
    """PCD files and the poses (4, 4) that the robot believes; the first is exact, so the map's frame is the room's."""

    first: list[tuple[Path, str]]
    second: tuple[Path, str]  #: after a crate was put there, and blind for x > `seen_to`
    seen_to: float  #: metres
    foreign: Path  #: of another building


@pytest.fixture(scope="session")
def visits(tmp_path_factory: pytest.TempPathFactory) -> Visits:
    folder = tmp_path_factory.mktemp("scans")
    room = random_room(5)
    first = visit(room, 5, seed=1, prior_error=(0.05, 1.0))
    later, _ = room.with_added("crate-new", crate(0.7, 0.5, 0.6).at(*_free_place(room)))
    second = visit(later, stops(later, 1, seed=2), seed=2, prior_error=(0.05, 1.0))[0]
    seen_to = float(room.bounds.mean(axis=0)[0])
    half = second.points[second.world_points[:, 0] < seen_to]
    other = visit(corridor(3), 1, seed=3)[0]
    return Visits(
        first=[
            (_written(folder / f"first-{number}.pcd", scan.points), _pose(scan, exact=number == 0))
            for number, scan in enumerate(first)
        ],
        second=(_written(folder / "second.pcd", half), _pose(second)),
        seen_to=seen_to,
        foreign=_written(folder / "foreign.pcd", other.points),
    )


def _free_place(room: Any) -> tuple[float, float]:
    low, high = room.rooms[0].low, room.rooms[0].high
    for x in np.linspace(low[0] + 0.6, high[0] - 0.6, 12):
        for y in np.linspace(low[1] + 0.6, high[1] - 0.6, 12):
            if room.is_free(crate(0.7, 0.5, 0.6).at(x, y).bounds):
                return float(x), float(y)
    raise AssertionError("no room for a crate")


def _written(path: Path, points: Any) -> Path:
    write_pcd(path, points)
    return path


def _pose(scan: SimulatedScan, *, exact: bool = False) -> str:
    return json.dumps((scan.world_from_sensor if exact else scan.prior).tolist())
