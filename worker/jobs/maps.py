"""The steps that build a map."""

from __future__ import annotations

import json

from service.catalog import blob_keys
from service.catalog.records import Bounds
from worker.cloud.formats.ply import write_ply
from worker.cloud.types import Points
from worker.detectors.card import Preprocessing
from worker.jobs.models import card_of, kept_detector, pipeline_settings
from worker.jobs.step import Context, put, step
from worker.jobs.versions import make_version
from worker.pipeline import archive
from worker.pipeline.flow import BuiltMap
from worker.pipeline.results.manifest import manifest, padded_patches


@step
def register_map(at: Context) -> None:
    """Scans to a fused, tiled map: the first version of it, or a later one."""
    version = at.catalog.versions.of_job(at.job.job_id)
    card = card_of(at, version.model)
    made = make_version(at, version, pipeline_settings(at, version, card))
    _put_map(at, made.built, card.preprocessing)
    at.catalog.versions.save_result(
        at.job.job_id,
        outcomes=made.outcomes,
        bounds=_bounds(made.built.reference.points),
        counts={
            "points": len(made.built.reference.points),
            "tiles": len(made.built.tiles.points),
            "scans": len(made.outcomes),
            "accepted": sum(outcome.accepted is True for outcome in made.outcomes),
        },
        registration=made.registration(),
    )
    at.catalog.blobs.delete_prefix(blob_keys.map_work(at.job.job_id))


@step
def encode_map(at: Context) -> None:
    """What the model can know of the reference alone; then the map is ready."""
    version = at.catalog.versions.of_job(at.job.job_id)
    detector = kept_detector(at, version.model)
    with at.catalog.blobs.local(blob_keys.map_tiles(at.job.job_id)) as path:
        tiles = archive.load_tiles(path)
    description = detector.describe(tiles, progress=lambda _, share: at.report("encoding", share))
    key = blob_keys.map_embedding(at.job.job_id, version.model, detector.card.sha256)
    put(at, key, lambda path: archive.save_arrays(path, description))
    at.catalog.jobs.succeed(at.job.job_id)


def _put_map(at: Context, built: BuiltMap, needs: Preprocessing) -> None:
    """The map's files: cloud, reference, tiles with their patches, manifest."""
    job_id, reference, tiles = at.job.job_id, built.reference, built.tiles
    patches = padded_patches(tiles, size=needs.patch_points, seed=needs.seed)
    put(at, blob_keys.map_reference(job_id), lambda path: archive.save_reference(path, reference))
    put(at, blob_keys.map_tiles(job_id), lambda path: archive.save_tiles(path, tiles, patches=patches))
    put(
        at,
        blob_keys.map_cloud(job_id),
        lambda path: write_ply(path, reference.points, colors=reference.colors),
    )
    listing = manifest(
        reference.points,
        tiles,
        patch_size=needs.patch_points,
        min_points=needs.min_points,
        voxel_size=needs.voxel_size,
    )
    at.catalog.blobs.put_bytes(blob_keys.map_manifest(job_id), json.dumps(listing).encode())


def _bounds(points: Points) -> Bounds:
    return Bounds(min=tuple(points.min(axis=0).tolist()), max=tuple(points.max(axis=0).tolist()))
