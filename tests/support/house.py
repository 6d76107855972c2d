"""A data folder with models of random weights, simulated scans, a map and two surveys: what tests of the steps start from."""

from __future__ import annotations

import hashlib
import importlib
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save
from sqlalchemy import update

from service.catalog.catalog import Catalog, open_catalog
from service.catalog.jobs import Jobs, Run
from service.catalog.records import JobRecord, ScanRecord, SurveyRecord
from service.catalog.sql import tables
from service.catalog.sql.database import Database
from service.catalog.steps import STEPS
from service.settings import Settings
from worker.cloud.formats.pcd import write_pcd
from worker.detectors.card import Card, Preprocessing
from worker.detectors.spicd_net.network import SpicdNetwork
from worker.simulation.scenes import random_room
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

MODEL, SAME_CUT, OTHER_CUT = "spicd-net/1", "spicd-net/2", "spicd-net/3"
MAP = "lobby"
#: no global search: priors are given, and what does not fit shall fail soon
SETTINGS = {"registration": {"search_resolutions": [], "max_iterations": 10}}
SEEN_TO = 2.4  # metres along x of the room; the survey is blind beyond


@dataclass(frozen=True)
class Material:
    """What was made once: the models, the scans, and a data folder with a map and two surveys of one scan, done."""

    model_store: Path
    data: Path
    before: tuple[SimulatedScan, ...]
    after: SimulatedScan
    foreign: SimulatedScan
    told: list[tuple[str, float]]  #: what the first survey reported
    left: list[Path]  #: in the temporary folder


@dataclass(frozen=True)
class House:
    """A data folder of one test's own, with the map built."""

    catalog: Catalog
    settings: Settings
    folder: Path
    material: Material

    def add(
        self, name: str, scan: SimulatedScan, *, seen_to: float = np.inf, pose: bool = True
    ) -> ScanRecord:
        path = self.folder / name
        write_pcd(path, scan.points[scan.world_points[:, 0] < seen_to])
        return self.add_file(name, path.read_bytes(), pose=scan.world_from_sensor if pose else None)

    def add_file(self, name: str, content: bytes, *, pose: Any = None) -> ScanRecord:
        path = self.folder / name
        path.write_bytes(content)
        record, _ = self.catalog.scans.add(
            path,
            filename=name,
            format="pcd",
            size=len(content),
            sha256=hashlib.sha256(content).hexdigest(),
            pose=None if pose is None else pose.tolist(),
        )
        return record

    @property
    def done(self) -> list[JobRecord]:
        """The jobs of the two surveys that are done: with the map's model, and with another and threshold 0."""
        ids = json.loads((self.material.data.parent / "jobs").read_text())
        return [self.catalog.jobs.get(job_id) for job_id in ids]

    def map_of(self, *scans: ScanRecord, map_id: str) -> JobRecord:
        ids = [scan.scan_id for scan in scans]
        return self.catalog.maps.create(scan_ids=ids, model=MODEL, map_id=map_id, settings=SETTINGS)[1]

    def survey_of(self, *scans: ScanRecord, model: str = MODEL, threshold: float | None = None) -> JobRecord:
        ids = [scan.scan_id for scan in scans]
        return self.catalog.surveys.create(MAP, scan_ids=ids, model=model, threshold=threshold)[1]

    def survey(self, job: JobRecord) -> SurveyRecord:
        assert job.survey_id is not None
        return self.catalog.surveys.get(job.survey_id)

    def files(self) -> dict[str, str]:
        """Every blob with the hash of its bytes."""
        root = self.settings.data_dir / "blobs"
        return {
            str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in root.rglob("*")
            if path.is_file()
        }

    def tiles(self, survey_id: str) -> list[dict[str, Any]]:
        return [change.tile.model_dump() for change in self.catalog.changes.of_survey(survey_id)]


def run(job: JobRecord, *names: str) -> None:
    """The steps of the job, or those named, as a worker would call them."""
    for step in STEPS[job.kind]:
        if not names or step.name in names:
            module, function = step.function.rsplit(".", 1)
            _have_due(job.job_id, step.name)
            getattr(importlib.import_module(module), function)(job.job_id)


def _have_due(job_id: str, step: str) -> None:
    """Have a step of an open job wait, as after a run of it that was lost."""
    database = Database(Settings().resolved_database_url())
    with database.write() as session:
        open_job = (tables.Job.job_id == job_id, tables.Job.status.in_(("accepted", "running")))
        session.execute(update(tables.Job).where(*open_job).values(step=step, begun=None))
    database.close()


def _models(folder: Path) -> None:
    torch.manual_seed(0)
    weights = save(SpicdNetwork().state_dict())
    for name, tile in ((MODEL, 1.5), (SAME_CUT, 1.5), (OTHER_CUT, 2.0)):
        card = Card(
            name="spicd-net",
            version=name.split("/")[1],
            detector="spicd-net",
            summary="never trained",
            threshold=0.4,
            preprocessing=Preprocessing(voxel_size=0.05, tile_size=(tile, tile, 1.0), min_points=512),
            detector_settings={"patch_points": 512, "seed": 42},
            weights="weights.safetensors",
            sha256=hashlib.sha256(weights).hexdigest(),
        )
        (folder / name).mkdir(parents=True)
        (folder / name / "weights.safetensors").write_bytes(weights)
        (folder / name / "card.json").write_text(card.model_dump_json())


def environment(patch: pytest.MonkeyPatch, data: Path, model_store: Path) -> Settings:
    """Settings of this folder and nothing else."""
    for name in Settings.model_fields:
        patch.delenv(f"SPICD_{name.upper()}", raising=False)
    patch.setenv("SPICD_DATA_DIR", str(data))
    patch.setenv("SPICD_MODEL_STORE", str(model_store))
    patch.setenv("SPICD_DEVICE", "cpu")
    return Settings()


def _overheard(told: list[tuple[str, float]]) -> Any:
    real = Jobs.report

    def report(self: Jobs, run: Run, *, message: str, progress: float) -> bool:
        told.append((message, progress))
        return real(self, run, message=message, progress=progress)

    return report


def made_material(folder: Path, temporary: Path) -> Material:
    """Everything made once; what the first survey reports and leaves in `temporary` is noted."""
    _models(folder / "models")
    scene = random_room(3)
    made = Material(
        model_store=folder / "models",
        data=folder / "data",
        before=visit(scene, 2, seed=1),
        after=visit(scene, 1, seed=2)[0],
        foreign=visit(random_room(11), 1, seed=5)[0],
        told=[],
        left=[],
    )
    with pytest.MonkeyPatch.context() as patch:
        settings = environment(patch, made.data, made.model_store)
        catalog = open_catalog(settings)
        house = House(catalog=catalog, settings=settings, folder=folder, material=made)
        scans = [house.add(f"before-{number}.pcd", scan) for number, scan in enumerate(made.before)]
        run(house.map_of(*scans, map_id=MAP))
        half = house.add("after.pcd", made.after, seen_to=SEEN_TO)
        patch.setattr(Jobs, "report", _overheard(made.told))
        patch.setattr("tempfile.tempdir", str(temporary))
        first = house.survey_of(half)
        run(first)
        made.left.extend(Path(str(tempfile.tempdir)).iterdir())
        patch.undo()
        environment(patch, made.data, made.model_store)
        other = house.survey_of(half, model=SAME_CUT, threshold=0.0)
        run(other)
        (folder / "jobs").write_text(json.dumps([first.job_id, other.job_id]))
        catalog.close()
    return made
