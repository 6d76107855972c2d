"""Takes a made map of millions of points, and a survey of it, through a service of its own.

A hall is scanned stop by stop. The scans are uploaded with poses that are a little off and become a map; then two scans
of one corner, where a crate was put, become a survey. While jobs run, what each of their stages takes is looked at twice
a second. Run it by `python -m tests.breaking.big_maps --through-service --points 5`.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tests.support.footprints import footprints
from tests.support.hall import PITCH, Hall
from tests.support.running_service import ROOT, Service
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.types import Matrix4
from worker.simulation.visits import drifted_within

MAP = "hall"
_PRIOR = (0.05, 0.5)  # metres and degrees that poses are off by at most
_TIME = 6 * 3600  # seconds that a step may take
_STEPS, _POOL = ("step of geometry", "inference worker"), "process of a pool"
_CRATE = (PITCH / 2 + 2.0, PITCH / 2 + 1.0)  # metres, in the first cell; things that stand there hide it


@dataclass
class StageRow:
    """What a stage of a job took."""

    seconds: float = 0.0
    own: int = 0  #: bytes, the most that the step's process held
    pool: int = 0  #: bytes, the most that its helpers held together


@dataclass
class Walk:
    """A run of the service."""

    service: Service
    folder: Path
    stages: dict[tuple[str, str], StageRow] = field(default_factory=dict)  #: by job and stage, in their order

    def upload(self, hall: Hall, poses: list[Matrix4], name: str, *, seed: int) -> list[str]:
        """Scan, upload and delete scan after scan; returns their ids."""
        ids = []
        for number, pose in enumerate(poses):
            path = self.folder / f"{name}-{number:03d}.pcd"
            write_pcd(path, hall.scan(pose, seed=seed + number))
            prior = drifted_within(pose, _PRIOR, np.random.default_rng([seed, number]))
            ids.append(self.service.upload(path, pose=json.dumps(prior.tolist())))
            path.unlink()
        return ids

    def follow(self, name: str, job_id: str) -> dict[str, Any]:
        """Follow a job to its end; notes what its stages take. Raises RuntimeError where it fails."""
        last = time.monotonic()
        while True:
            job = self.service.get(f"/jobs/{job_id}")
            now = time.monotonic()
            row = self.stages.setdefault((name, f"{job['step']}: {job['message']}"), StageRow())
            row.seconds, last = row.seconds + now - last, now
            if job["status"] not in ("accepted", "running"):
                break
            taken = footprints(self.service.process.pid)
            row.own = max([row.own, *(taken[step].resident for step in _STEPS if step in taken)])
            row.pool = max(row.pool, taken[_POOL].resident if _POOL in taken else 0)
            time.sleep(0.5)
        if job["status"] != "successful":
            raise RuntimeError(f"{job}\n{self.service.log.read_text()[-4000:]}")
        return dict(job)


def run(points: float, parent: Path) -> int:
    """Run it, print what it took and what is wrong; returns how many things are."""
    with TemporaryDirectory(dir=parent, prefix="big-service-") as folder:
        service = Service(Path(folder), ROOT / "model_store", job_timeout_s=_TIME)
        try:
            return _walked(Walk(service=service, folder=Path(folder)), Hall.of(points * 1e6))
        finally:
            service.end()


def _walked(walk: Walk, hall: Hall) -> int:
    begun = time.monotonic()
    stops = [hall.stop(number, yaw=37.0 * number) for number in range(hall.cells**2)]
    ids = walk.upload(hall, stops, "map", seed=100)
    print(f"{len(ids)} scans made and uploaded in {time.monotonic() - begun:.0f} s", flush=True)
    job = walk.service.post("/maps", id=MAP, scan_ids=ids)
    try:
        walk.follow("map", job["job_id"])
        later = hall.with_crate(*_CRATE)
        views = [later.stop(0, aside=0.6, yaw=10.0), later.stop(0, aside=-0.6, yaw=200.0)]
        survey = walk.service.post(
            f"/maps/{MAP}/surveys", scan_ids=walk.upload(later, views, "survey", seed=900)
        )
        walk.follow("survey", survey["job_id"])
    finally:
        print(_table(walk.stages))
    wrong = [*_wrong_map(walk.service, len(ids)), *_wrong_survey(walk.service, survey["survey_id"])]
    print("\n".join(wrong) or "all is there")
    return len(wrong)


def _wrong_map(service: Service, scans: int) -> Iterator[str]:
    """Yield what is wrong with the map's files."""
    document = service.get(f"/maps/{MAP}")
    points = document["counts"]["points"]
    vertices = _vertices(service, f"/maps/{MAP}/cloud.ply")
    print(f"{points:,} points, {document['counts']['accepted']} of {scans} scans", flush=True)
    if document["counts"]["accepted"] != scans:
        yield f"{document['counts']['accepted']} of {scans} scans are in the map"
    if (vertices, document["tileset"]["n_points"]) != (points, points):
        yield f"of {points} points cloud.ply has {vertices}, the tileset {document['tileset']['n_points']}"


def _wrong_survey(service: Service, survey_id: str) -> Iterator[str]:
    """Yield what is wrong with the survey's files and with what it found."""
    vertices = _vertices(service, f"/surveys/{survey_id}/cloud.ply")
    picture = service.http.get(f"/surveys/{survey_id}/picture.png")
    width, height = struct.unpack(">II", picture.content[16:24])
    print(f"the survey's cloud has {vertices:,} points, its picture {width} x {height} pixels", flush=True)
    if picture.status_code != 200 or not picture.content.startswith(b"\x89PNG"):
        yield f"the picture: {picture.status_code}"
    objects = service.get(f"/surveys/{survey_id}/objects")["features"]
    middles = [np.array([thing["properties"][f"center_{axis}"] for axis in "xy"]) for thing in objects]
    print(f"{len(objects)} objects", flush=True)
    if not any(np.hypot(*(middle - _CRATE)) < 0.5 for middle in middles):
        yield f"the crate at {_CRATE} is not among the objects at {[m.round(1).tolist() for m in middles]}"


def _vertices(service: Service, path: str) -> int:
    """Return the points that the header of a PLY file announces."""
    with service.http.stream("GET", path) as answer:
        head = next(answer.iter_bytes(4096))
    return int(head.partition(b"element vertex ")[2].split()[0])


def _table(stages: dict[tuple[str, str], StageRow]) -> str:
    lines = ["| job | stage | s | its process | its pool |", "| --- | --- | ---: | ---: | ---: |"]
    for (job, stage), row in stages.items():
        pool = f"{row.pool / 1e6:.0f} MB" if row.pool else ""
        lines.append(f"| {job} | {stage} | {row.seconds:.0f} | {row.own / 1e6:.0f} MB | {pool} |")
    return "\n".join(lines)
