"""A small catalog to look at: two maps of a simulated room and four surveys of it, made by the real steps of the jobs.

    python -m tests.support.viewer_data FOLDER

fills FOLDER, which `spicd up --data-dir FOLDER/data` serves. The map `den` has no colours, `den-in-colour` has. Of the
den there is a survey in which nothing changed, one in which a crate came, a carton went and a plant was moved, one that
saw half of the room, and one whose only scan is of another building.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from service.catalog.catalog import Catalog, open_catalog
from tests.support.house import environment, run
from worker.cloud.formats.ply import write_ply
from worker.cloud.types import Colors
from worker.detectors.card import MODEL_STORE
from worker.pipeline.flow import NoScanAccepted
from worker.simulation.scenes import Change, Scene, corridor, random_room
from worker.simulation.scenes.furniture import crate
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

MODEL, MAP, COLOURED = "voxel-net/1", "den", "den-in-colour"
#: no global search: priors are given, and what does not fit shall fail soon
SETTINGS = {"registration": {"search_resolutions": [], "max_iterations": 10}}
SEEN_TO = 3.4  #: metres along x of the room of 7.1; one survey is blind beyond
_SCAN_S = 1.0  #: of a scan: 20,000 points


@dataclass(frozen=True, kw_only=True)
class ViewerData:
    """Where the data lie, the ids of the surveys by what they show, and what was truly done in the room."""

    folder: Path
    surveys: dict[str, str]  #: quiet, objects, half, failed
    changes: dict[
        str, list[list[list[float]]]
    ]  #: kind to [before, after] where there are such; boxes (2, 3), metres

    @property
    def data(self) -> Path:
        """Return the data folder of the service."""
        return self.folder / "data"


def story() -> tuple[Scene, Scene, dict[str, Change]]:
    """Return the room before and after, and the edits by the kind that the service should tell."""
    before = random_room(21)
    first, came = before.with_added("crate-new", crate(0.7, 0.5, 0.6).at(5.3, 4.2, yaw=15))
    second, went = first.without("carton-1")
    after, moved = second.shifted("plant-1", dx=-1.4, dy=0.3)
    return before, after, {"appeared": came, "disappeared": went, "moved": moved}


def made(folder: Path) -> ViewerData:
    """Return the data of a folder; make them where they are not there, in one process at a time."""
    folder.mkdir(parents=True, exist_ok=True)
    told = folder / "viewer.json"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not told.exists():
            _make(folder)
    return ViewerData(folder=folder, **json.loads(told.read_text()))


def _make(folder: Path) -> None:
    shutil.rmtree(folder / "data", ignore_errors=True)  # of one who was killed
    before, after, changes = story()
    with pytest.MonkeyPatch.context() as patch:
        settings = environment(patch, folder / "data", MODEL_STORE)
        maker = _Maker(open_catalog(settings), folder)
        first = visit(before, 4, seed=1, duration_s=_SCAN_S)
        maker.map(MAP, "The den", first, coloured=False)
        maker.map(COLOURED, "The den, in colour", first[:3], coloured=True)
        seen = visit(after, 4, seed=14, duration_s=_SCAN_S)
        surveys = {
            "quiet": maker.survey(2, visit(before, 3, seed=11, duration_s=_SCAN_S)),
            "objects": maker.survey(3, seen),
            "half": maker.survey(4, [_left_of(scan, SEEN_TO) for scan in seen[:3]]),
            "failed": maker.survey(5, visit(corridor(3), 1, seed=3, duration_s=_SCAN_S), poses=False),
        }
        maker.catalog.close()
    boxes = {kind: _boxes(change) for kind, change in changes.items()}
    (folder / "viewer.json").write_text(json.dumps({"surveys": surveys, "changes": boxes}))


@dataclass(frozen=True)
class _Maker:
    """Puts scans into a catalog and runs the jobs."""

    catalog: Catalog
    folder: Path

    def map(self, map_id: str, name: str, scans: Sequence[SimulatedScan], *, coloured: bool) -> None:
        ids = [self._scan(f"{map_id}-{number}", scan, coloured=coloured) for number, scan in enumerate(scans)]
        run(
            self.catalog.maps.create(scan_ids=ids, model=MODEL, map_id=map_id, name=name, settings=SETTINGS)[
                1
            ]
        )

    def survey(self, day: int, scans: Sequence[SimulatedScan], *, poses: bool = True) -> str:
        ids = [self._scan(f"march-{day}-{number}", scan, pose=poses) for number, scan in enumerate(scans)]
        when = datetime(2026, 3, day, 12, tzinfo=UTC)
        survey, job = self.catalog.surveys.create(
            MAP, scan_ids=ids, model=MODEL, captured_at=when, device_id="robot-7"
        )
        with contextlib.suppress(NoScanAccepted):
            run(job)
        return survey.survey_id

    def _scan(self, name: str, scan: SimulatedScan, *, coloured: bool = False, pose: bool = True) -> str:
        path = self.folder / f"{name}.ply"
        write_ply(path, scan.points, colors=_colours(scan) if coloured else None)
        content = path.read_bytes()
        record, _ = self.catalog.scans.add(
            path,
            filename=path.name,
            format="ply",
            size=len(content),
            sha256=hashlib.sha256(content).hexdigest(),
            pose=scan.world_from_sensor.tolist() if pose else None,
        )
        return record.scan_id


def _left_of(scan: SimulatedScan, x: float) -> SimulatedScan:
    """Return what a scan saw up to `x` metres of the room."""
    kept = scan.world_points[:, 0] < x
    return replace(scan, points=scan.points[kept], object_ids=scan.object_ids[kept])


def _colours(scan: SimulatedScan) -> Colors:
    """Return a colour of its own for each solid, (N, 3) uint8, the darker the lower."""
    hue = (scan.object_ids.astype(np.int64)[:, None] * (67, 131, 29)) % 160
    light = np.clip(scan.world_points[:, 2:], 0.0, 2.5) * 36
    return np.clip(hue + light, 0, 255).astype(np.uint8)


def _boxes(change: Change) -> list[list[list[float]]]:
    """Return where the thing was and where it is: a box for each that there is."""
    return [box.tolist() for box in (change.before, change.after) if box is not None]


if __name__ == "__main__":
    sys.stdout.write(f"{made(Path(sys.argv[1])).data}\n")
