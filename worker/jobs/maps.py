"""The steps that build a map."""

from __future__ import annotations

import json

from service.catalog.files import blob_keys
from service.catalog.records import Bounds, Tileset, VersionRecord
from worker.cloud import npz
from worker.cloud.formats.laz import write_laz
from worker.cloud.formats.ply import write_ply
from worker.cloud.tilesets.writer import pieces_of
from worker.cloud.types import Points
from worker.detectors.card import Card
from worker.detectors.comparison import Side
from worker.detectors.detector import Detector
from worker.jobs.models import card_of, kept_detector, pipeline_settings
from worker.jobs.stations import take_stations_apart
from worker.jobs.step import Context, put, step
from worker.jobs.tilesets import put_tileset
from worker.jobs.versions import kept_alarms, kept_reference, make_version
from worker.pipeline.flow import BuiltMap
from worker.pipeline.results.manifest import manifest


@step
def register_map(context: Context) -> None:
    """Build a fused, tiled map of scans: the first version of it, or a later one."""
    versions, job_id = context.catalog.versions, context.job.job_id
    given = versions.of_job(job_id).scans
    refused = take_stations_apart(context, job_id, given, versions.take_apart, stage="reading")
    version = versions.of_job(job_id)
    card = card_of(context, version.model)
    made = make_version(context, version, pipeline_settings(context, version, card), refused=refused)
    tileset = _put_map(context, made.built, card)
    context.catalog.versions.save_result(
        context.job.job_id,
        outcomes=made.outcomes,
        bounds=_bounds(made.built.reference.points),
        counts={
            "points": len(made.built.reference.points),
            "tiles": len(made.built.tiles.points),
            "scans": len(made.outcomes),
            "accepted": sum(outcome.accepted is True for outcome in made.outcomes),
        },
        registration=made.registration(),
        tileset=tileset,
    )
    context.catalog.blobs.delete_prefix(blob_keys.map_work(context.job.job_id))


@step
def encode_map(context: Context) -> None:
    """Keep what the model can know of the reference alone, and what it finds where nothing changed."""
    version = context.catalog.versions.of_job(context.job.job_id)
    with kept_detector(context, version.model) as detector:
        encode_reference(context, version, detector, version.model)
        if detector.card.preprocessing.tiles == "touched":
            settings = pipeline_settings(context, version, detector.card)
            kept_alarms(context, version, detector, version.model, settings)
    context.catalog.jobs.succeed(context.job.job_id, run=context.run)


def encode_reference(context: Context, version: VersionRecord, detector: Detector, model: str) -> None:
    """Keep what the model can compute of the map alone, so that its first survey has half of the work."""
    reference = kept_reference(context, version)
    embedding = detector.encode_reference(
        Side(points=reference.points, normals=reference.normals),
        reference.tiles(min_points=detector.card.preprocessing.min_points),
        progress=lambda _, share: context.report("encoding", share),
    )
    key = blob_keys.map_embedding(version.job_id, model, detector.card.fingerprint)
    put(context, key, lambda path: npz.save_arrays(path, embedding))


def _put_map(context: Context, built: BuiltMap, card: Card) -> Tileset:
    """Keep the map's files: cloud, reference, what its scans saw, manifest, and the tileset, which is returned."""
    job_id, reference, needs = context.job.job_id, built.reference, card.preprocessing
    put(context, blob_keys.map_reference(job_id), lambda path: npz.save(path, reference))
    put(context, blob_keys.map_seen(job_id), lambda path: npz.save(path, built.seen))
    put(
        context,
        blob_keys.map_cloud(job_id),
        lambda path: write_ply(path, reference.points, colors=reference.colors),
    )
    put(
        context,
        blob_keys.map_laz(job_id),
        lambda path: write_laz(path, reference.points, colors=reference.colors),
    )
    listing = manifest(
        reference.points,
        built.tiles,
        patch_size=card.detector_settings.get("patch_points"),  # of detectors that have patches
        min_points=needs.min_points,
        voxel_size=needs.voxel_size,
    )
    context.catalog.blobs.put_bytes(blob_keys.map_manifest(job_id), json.dumps(listing).encode())
    return put_tileset(
        context,
        lambda: pieces_of(reference.points, colors=reference.colors, normals=reference.normals),
        document=blob_keys.map_tileset(job_id),
        contents=blob_keys.map_tileset_contents(job_id),
        progress=lambda share: context.report("exporting", share),
    )


def _bounds(points: Points) -> Bounds:
    return Bounds(min=tuple(points.min(axis=0).tolist()), max=tuple(points.max(axis=0).tolist()))
