"""The steps that build a map."""

from __future__ import annotations

import functools
import json
from contextlib import ExitStack

from service.catalog import keys
from service.catalog.records import Bounds
from worker.detectors.card import Preprocessing
from worker.detectors.store import open_card
from worker.jobs.models import kept_detector, pipeline_settings
from worker.jobs.scans import save_scans, scan_files, scan_outcomes
from worker.jobs.step import Context, put, step
from worker.pipeline import archive
from worker.pipeline.flow import BuiltMap, NothingToTile, build_map
from worker.pipeline.manifest import manifest, padded_patches
from worker.pipeline.ply import write_ply
from worker.pipeline.values import Points


@step
def register_map(at: Context) -> None:
    """Scans to a fused, tiled map."""
    record = at.catalog.versions.of_job(at.job.job_id)
    card = open_card(at.settings.model_store, record.model)
    with ExitStack() as stack:
        files = scan_files(at, record.scans, stack)
        try:
            built = build_map(files, settings=pipeline_settings(at, record, card), progress=at.report)
        except NothingToTile as error:
            outcomes = scan_outcomes(record.scans, error.outcomes)
            at.catalog.versions.save_outcomes(at.job.job_id, outcomes)
            raise
    at.report("saving", 0.0)
    outcomes = scan_outcomes(record.scans, built.outcomes)
    save_scans(at, record.scans, built.outcomes, functools.partial(keys.map_scan, at.job.job_id))
    _put_map(at, built, card.preprocessing)
    at.catalog.versions.save_result(
        at.job.job_id,
        outcomes=outcomes,
        bounds=_bounds(built.reference.points),
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
    record = at.catalog.versions.of_job(at.job.job_id)
    detector = kept_detector(at.settings, record.model)
    with at.catalog.blobs.local(keys.map_tiles(at.job.job_id)) as path:
        tiles = archive.load_tiles(path)
    description = detector.describe(tiles, progress=lambda _, share: at.report("describing", share))
    key = keys.map_description(at.job.job_id, record.model)
    put(at, key, lambda path: archive.save_arrays(path, description))
    at.catalog.jobs.succeed(at.job.job_id)


def _put_map(at: Context, built: BuiltMap, needs: Preprocessing) -> None:
    """The map's files: cloud, reference, tiles with their patches, manifest."""
    job_id, reference, tiles = at.job.job_id, built.reference, built.tiles
    patches = padded_patches(tiles, size=needs.patch_points, seed=needs.seed)
    put(at, keys.map_reference(job_id), lambda path: archive.save_reference(path, reference))
    put(at, keys.map_tiles(job_id), lambda path: archive.save_tiles(path, tiles, patches=patches))
    put(at, keys.map_cloud(job_id), lambda path: write_ply(path, reference.points, colors=reference.colors))
    listing = manifest(
        reference.points,
        tiles,
        patch_size=needs.patch_points,
        min_points=needs.min_points,
        voxel_size=needs.voxel_size,
    )
    at.catalog.blobs.put_bytes(keys.map_manifest(job_id), json.dumps(listing).encode())


def _bounds(points: Points) -> Bounds:
    return Bounds(min=tuple(points.min(axis=0).tolist()), max=tuple(points.max(axis=0).tolist()))
