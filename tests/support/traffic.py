"""Small simulated scans of one room, and clients that send them slowly."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np

from worker.cloud.formats.pcd import write_pcd
from worker.simulation.scenes import random_room
from worker.simulation.visits import visit

_PIECES_A_SECOND = 10  # that a slow client sends
_NOISE = 0.001  # metres; makes of one simulated scan as many different files as are wanted


@dataclass(frozen=True)
class Upload:
    """A PCD file, and where the robot believes that it was taken."""

    name: str
    content: bytes
    pose: str  #: JSON of (4, 4) map_from_sensor


class Room:
    """A simulated room: scans for its map, and as many further ones as are asked for."""

    def __init__(self, *, map_scans: int = 3, views: int = 5, scan_s: float = 2.0) -> None:
        room = random_room(5)
        self._first = visit(room, map_scans, seed=1, duration_s=scan_s)
        self._later = visit(room, views, seed=2, prior_error=(0.05, 1.0), duration_s=scan_s)

    def map_uploads(self) -> list[Upload]:
        """Return the scans that the map is built of; their poses are exact."""
        return [as_upload(f"map-{k}", scan.points, scan.prior) for k, scan in enumerate(self._first)]

    def survey_upload(self, number: int) -> Upload:
        """Return the scan of a survey: another file for each number."""
        scan = self._later[number % len(self._later)]
        noise = np.random.default_rng([number, 7]).normal(0, _NOISE, scan.points.shape)
        return as_upload(f"survey-{number}", scan.points + noise.astype(np.float32), scan.prior)


def as_upload(name: str, points: Any, pose: Any) -> Upload:
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.pcd"
        write_pcd(path, points)
        return Upload(f"{name}.pcd", path.read_bytes(), json.dumps(pose.tolist()))


def throttled(content: bytes, bytes_a_second: float) -> Iterator[bytes]:
    """Yield the content in pieces, no faster than that."""
    size = max(1, int(bytes_a_second / _PIECES_A_SECOND))
    begun = time.monotonic()
    for sent in range(0, len(content), size):
        time.sleep(max(0.0, begun + sent / bytes_a_second - time.monotonic()))
        yield content[sent : sent + size]


def send_scan(http: httpx.Client, upload: Upload, *, bytes_a_second: float = float("inf")) -> httpx.Response:
    """POST a scan as a raw body."""
    slow = bytes_a_second != float("inf")
    return http.post(
        "/scans",
        params={"filename": upload.name, "pose": upload.pose},
        content=throttled(upload.content, bytes_a_second) if slow else upload.content,
        headers={"Content-Type": "application/octet-stream", "Content-Length": str(len(upload.content))},
    )
