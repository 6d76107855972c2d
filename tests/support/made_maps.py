"""Maps of as many points as are asked for, put into a catalog without a job: surfaces of a simulated office, sampled."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from service.catalog.catalog import Catalog
from service.catalog.files import blob_keys
from service.catalog.files.tilesets import address
from service.catalog.records import Bounds, ScanOutcome, Tileset
from tests.support.samples import IDENTITY, add_scan
from worker.cloud.formats.ply import write_ply
from worker.cloud.tilesets.writer import pieces_of, write_tileset
from worker.cloud.types import Points
from worker.simulation.scenes import Scene, small_office

_STOREYS = 4  #: of offices above each other, for large clouds
_NOISE = 0.004  # metres


def office_points(count: int, *, seed: int = 0) -> Points:
    """Return (count, 3) float32 points all over the surfaces of an office, in metres; above a million, of four storeys."""
    rng = np.random.default_rng(seed)
    points = sampled(small_office(2), count, rng)
    if count > 1_000_000:
        points[:, 2] += 2.9 * rng.integers(0, _STOREYS, count)
    return points


def sampled(scene: Scene, count: int, rng: np.random.Generator) -> Points:
    """Return (count, 3) float32 points, equally likely on each square metre of the scene's solids."""
    corners = np.concatenate([item.mesh.vertices[item.mesh.triangles] for item in scene.objects])  # (T, 3, 3)
    edges = corners[:, 1:] - corners[:, :1]
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    chosen = rng.choice(len(corners), count, p=areas / areas.sum())
    along = rng.random((count, 2), np.float32)
    along[along.sum(axis=1) > 1] = 1 - along[along.sum(axis=1) > 1]  # the other half of the parallelogram
    points = corners[chosen, 0].astype(np.float32)
    for edge in range(2):
        points += along[:, edge, None] * edges[chosen, edge].astype(np.float32)
    points += rng.normal(0.0, _NOISE, points.shape).astype(np.float32)
    return points


def put_map(
    catalog: Catalog,
    map_id: str,
    points: Points,
    *,
    tileset: bool,
    ply: bool = True,
    counted: int | None = None,
) -> None:
    """Put a map that is ready: its cloud as PLY, and where asked for as a tileset too.

    Its document says that it has `counted` points, which is what the viewer chooses by; left out: those that it has.
    """
    scan = add_scan(catalog, f"map-{map_id}")
    _, job = catalog.maps.create(scan_ids=[scan.scan_id], model="voxel-net/1", map_id=map_id, name=map_id)
    with TemporaryDirectory() as name:
        folder = Path(name)
        if ply:
            write_ply(folder / "cloud.ply", points)
            catalog.blobs.put_file(blob_keys.map_cloud(job.job_id), folder / "cloud.ply", move=True)
        kept = _put_tileset(catalog, job.job_id, points, folder) if tileset else None
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    catalog.versions.save_result(
        job.job_id,
        outcomes=[
            ScanOutcome(scan_id=scan.scan_id, accepted=True, fitness=1.0, rmse=0.01, map_from_scan=IDENTITY)
        ],
        bounds=Bounds(min=tuple(low), max=tuple(high)),
        counts={"points": counted or len(points), "tiles": 0, "scans": 1, "accepted": 1},
        tileset=kept,
    )
    catalog.jobs.succeed(job.job_id)


def _put_tileset(catalog: Catalog, job_id: str, points: Points, folder: Path) -> Tileset:
    index, contents = folder / "tileset.json", folder / "tileset.bin"
    summary = write_tileset(
        index,
        contents,
        lambda: pieces_of(points),
        scratch=folder,
        address=lambda at: address(at.sha256, at.offset, at.length),
    )
    catalog.blobs.put_file(blob_keys.map_tileset_contents(job_id), contents, move=True)
    catalog.blobs.put_file(blob_keys.map_tileset(job_id), index, move=True)
    return Tileset.model_validate(asdict(summary))
