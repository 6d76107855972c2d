"""The steps that build a map."""

from __future__ import annotations

import functools
import json
from contextlib import ExitStack

from service.catalog import keys
from service.catalog.records import Bounds
from worker.detectors.store import open_card
from worker.errors import MapFailed
from worker.jobs.models import kept_detector, pipeline_settings
from worker.jobs.scans import save_scans, scan_files, scan_outcomes
from worker.jobs.step import Context, put, step
from worker.pipeline import archive
from worker.pipeline.flow import build_map
from worker.pipeline.manifest import manifest, padded_patches
from worker.pipeline.ply import write_ply


@step
def register_map(at: Context) -> None:
    """Scans to a fused, tiled map."""
    record = at.catalog.maps.get(at.job.map_id)
    card = open_card(at.settings.model_store, record.model)
    with ExitStack() as stack:
        files = scan_files(at, record.scans, stack)
        built = build_map(files, settings=pipeline_settings(at, record, card), progress=at.report)
    at.report("saving", 0.0)
    outcomes = scan_outcomes(record.scans, built.outcomes)
    at.catalog.maps.save_outcomes(record.map_id, outcomes, job_id=at.job.job_id)
    if not built.tiles.points:
        raise MapFailed(
            f"no tile holds {card.preprocessing.min_points} points of the fused map "
            f"({len(built.reference.points)} points in all); add scans"
        )
    put(at, keys.map_reference(at.job.job_id), lambda path: archive.save_reference(path, built.reference))
    patches = padded_patches(built.tiles, size=card.preprocessing.patch_points, seed=card.preprocessing.seed)
    put(
        at,
        keys.map_tiles(at.job.job_id),
        lambda path: archive.save_tiles(path, built.tiles, patches=patches),
    )
    put(
        at,
        keys.map_cloud(at.job.job_id),
        lambda path: write_ply(path, built.reference.points, colors=built.reference.colors),
    )
    save_scans(at, record.scans, built.outcomes, functools.partial(keys.map_scan, at.job.job_id))
    listing = manifest(
        built.reference.points,
        built.tiles,
        patch_size=card.preprocessing.patch_points,
        min_points=card.preprocessing.min_points,
        voxel_size=card.preprocessing.voxel_size,
    )
    at.catalog.blobs.put_bytes(keys.map_manifest(at.job.job_id), json.dumps(listing).encode())
    at.catalog.maps.save_result(
        record.map_id,
        job_id=at.job.job_id,
        outcomes=outcomes,
        bounds=Bounds.model_validate(listing["map_bounds"]),
        counts={
            "points": len(built.reference.points),
            "tiles": len(built.tiles.points),
            "scans": len(built.outcomes),
            "accepted": sum(outcome.scan is not None for outcome in built.outcomes),
        },
    )


@step
def describe_map(at: Context) -> None:
    """What the model can know of the reference alone; then the map is ready."""
    record = at.catalog.maps.get(at.job.map_id)
    detector = kept_detector(at.settings, record.model)
    with at.catalog.blobs.local(keys.map_tiles(at.job.job_id)) as path:
        tiles = archive.load_tiles(path)
    description = detector.describe(tiles, progress=lambda _, share: at.report("describing", share))
    key = keys.map_description(at.job.job_id, record.model)
    put(at, key, lambda path: archive.save_arrays(path, description))
    at.catalog.jobs.succeed(at.job.job_id)
