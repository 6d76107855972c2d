"""The steps that compare a survey with its map."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict

from service.catalog.files import blob_keys
from service.catalog.records import (
    Bounds,
    Motion,
    ObjectRecord,
    Place,
    Placement,
    SurveyRecord,
    TileRecord,
    Tileset,
    VersionRecord,
)
from worker.cloud import npz
from worker.cloud.tilesets.writer import pieces_of
from worker.detectors.card import Card
from worker.detectors.comparison import Comparison
from worker.detectors.detector import Detection
from worker.errors import MapFailed, ScanError
from worker.jobs.models import card_of, card_that_fits, kept_detector, pipeline_settings
from worker.jobs.scans import (
    kept_placement,
    kept_scans,
    recorded_placement,
    save_scans,
    scan_files,
    scan_outcomes,
    seen_by,
    unread,
)
from worker.jobs.stations import take_stations_apart
from worker.jobs.step import Context, load, put, step
from worker.jobs.tilesets import put_tileset
from worker.jobs.versions import kept_alarms, kept_reference, kept_seen
from worker.pipeline.alarms import AlarmCalibration
from worker.pipeline.flow import NoScanAccepted, compare, concluded, locate_survey
from worker.pipeline.mapping.fusion import CurrentMap, ReferenceMap
from worker.pipeline.registration.results import ScanResult
from worker.pipeline.results.changes import ChangeSet
from worker.pipeline.results.export import ColouredCloud, TileResult, tile_results
from worker.pipeline.results.objects import ChangeObject
from worker.pipeline.results.picture import draw_picture
from worker.pipeline.results.refusal import draw_refusal
from worker.pipeline.results.sheet import LeftOut
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress

READ_WHOLE = 1_000_000  #: points of a survey's cloud that viewers read as one PLY; a larger one has a tileset


@step
def register_survey(context: Context) -> None:
    """Fuse the scans to one cloud in the map's frame; a survey with no accepted scan fails here."""
    given, surveys = _asked(context)[0], context.catalog.surveys
    refused = take_stations_apart(
        context, given.survey_id, given.scans, surveys.take_apart, stage="registering"
    )
    survey, version, settings = _asked(context)
    reference = kept_reference(context, version)
    seen = None
    with suppress(MapFailed):  # without what the map's scans saw, poses are judged by surfaces alone
        seen = kept_seen(context, version, voxel_size=settings.registration.voxel_size)
    with ExitStack() as stack:
        files = scan_files(context, survey.scans, stack, settings, refused=refused)
        try:
            located = locate_survey(
                files, reference, settings=settings, reference_seen=seen, progress=context.report
            )
        except NoScanAccepted as error:
            _refuse(context, survey, error.outcomes, reference)
            raise
        except ScanError as error:
            left_out = unread(files, error, max_points=settings.max_scan_points)
            _refuse(context, survey, left_out, reference)
            raise
        key_of = functools.partial(blob_keys.survey_scan, survey.survey_id)
        save_scans(context, survey.scans, files, located.outcomes, key_of)
    context.catalog.surveys.save_outcomes(
        survey.survey_id,
        scan_outcomes(survey.scans, located.outcomes),
        placement=recorded_placement(located.placement),
    )
    put(context, blob_keys.survey_current(survey.survey_id), lambda path: npz.save(path, located.current))
    put(context, blob_keys.survey_seen(survey.survey_id), lambda path: npz.save(path, located.seen))


@step
def score_survey(context: Context) -> None:
    """Score the map and the survey side by side: class probabilities."""
    survey, version, settings = _asked(context)
    comparison = _compared(context, survey, version, settings)
    with kept_detector(context, survey.model) as detector:
        embedding = None
        key = blob_keys.map_embedding(version.job_id, survey.model, detector.card.fingerprint)
        if context.catalog.blobs.exists(key):
            embedding = load(context, key, npz.load_arrays)
        progress = scoring(context.report, encoded=embedding is not None)
        detection = detector.detect(comparison, embedding=embedding, progress=progress)
        if detection.voxels is not None:  # kept with the map, for the next step, which opens no network
            kept_alarms(context, version, detector, survey.model, settings)
    put(context, blob_keys.survey_scores(survey.survey_id), lambda path: npz.save(path, detection))


@step
def export_survey(context: Context) -> None:
    """Make of the scores tile states, objects, the coloured cloud and the picture; then the survey is ready."""
    survey, version, settings = _asked(context)
    survey_id = survey.survey_id
    context.report("exporting", 0.0)
    comparison = _compared(context, survey, version, settings)
    detection = load(context, blob_keys.survey_scores(survey_id), functools.partial(npz.load, kind=Detection))
    card = card_of(context, survey.model)
    limit = _least_score(context, version, card, survey.model) if detection.voxels is not None else 0.0
    asked = survey.asked_threshold
    threshold = card.threshold if asked is None else asked
    objects = settings.objects.with_values(min_score=max(limit, settings.objects.min_score))
    changes = concluded(
        comparison,
        detection,
        threshold=threshold,
        settings=settings.with_values(objects=objects),
        placement=kept_placement(survey.placement),
        by_objects=asked is None,
    )
    context.report("exporting", 0.3)
    tileset = _put_cloud_and_picture(context, survey, comparison, changes)
    context.report("exporting", 0.9)
    context.catalog.surveys.save_result(
        survey_id,
        tiles=[_tile_record(result) for result in tile_results(changes)],
        threshold=threshold,
        objects=None if changes.objects is None else map(_object_record, changes.objects.objects),
        moving=None if changes.objects is None else changes.objects.moving,
        tileset=tileset,
    )
    context.catalog.jobs.succeed(context.job.job_id, run=context.run)


def _refuse(
    context: Context, survey: SurveyRecord, outcomes: Sequence[ScanResult], reference: ReferenceMap
) -> None:
    """Record that no scan of a survey was accepted, and why; keep a picture that says so."""
    context.catalog.surveys.save_outcomes(
        survey.survey_id,
        scan_outcomes(survey.scans, outcomes),
        placement=Placement(state="refused", confidence=None),
    )
    left_out = [
        LeftOut(name=one.name, reason=one.diagnosis.reason, detail=one.diagnosis.detail)
        for one in outcomes
        if one.diagnosis is not None
    ]
    put(
        context,
        blob_keys.survey_picture(survey.survey_id),
        lambda path: draw_refusal(path, reference.points, left_out, title=_title(survey)),
    )


def _title(survey: SurveyRecord) -> str:
    return f"Map {survey.map_id}: survey of {survey.captured_at:%Y-%m-%d %H:%M} UTC"


def _left_out(context: Context, survey: SurveyRecord) -> list[LeftOut]:
    """Return the scans that were left out, by the names of their files."""
    return [
        LeftOut(
            name=context.catalog.scans.get(scan.scan_id).filename,
            reason=scan.reason or "",
            detail=scan.detail or "",
        )
        for scan in survey.scans
        if scan.accepted is False
    ]


def _least_score(context: Context, version: VersionRecord, card: Card, model: str) -> float:
    """Return the limit on a region's score that the step before has kept with the map."""
    key = blob_keys.map_alarms(version.job_id, model, card.fingerprint)
    return load(context, key, functools.partial(npz.load, kind=AlarmCalibration)).min_score


def _put_cloud_and_picture(
    context: Context, survey: SurveyRecord, comparison: Comparison, changes: ChangeSet
) -> Tileset | None:
    """Keep the cloud and the picture; return how large the cloud's tileset is, where it has one."""
    reference, current = comparison.reference.points, comparison.current.points
    left_out = _left_out(context, survey)
    cloud = ColouredCloud.of(reference, current, changes)
    put(context, blob_keys.survey_cloud(survey.survey_id), cloud.write_ply)
    tileset = _put_tileset(context, survey.survey_id, cloud)
    put(context, blob_keys.survey_laz(survey.survey_id), cloud.write_laz)
    context.report("exporting", 0.6)
    put(
        context,
        blob_keys.survey_picture(survey.survey_id),
        lambda path: draw_picture(path, reference, current, changes, title=_title(survey), left_out=left_out),
    )
    return tileset


def _put_tileset(context: Context, survey_id: str, cloud: ColouredCloud) -> Tileset | None:
    """Write the tileset of a cloud that is too large to be read whole; a smaller one has none."""
    if len(cloud.points) <= READ_WHOLE:
        return None
    return put_tileset(
        context,
        lambda: pieces_of(cloud.points, colors=cloud.colors),
        document=blob_keys.survey_tileset(survey_id),
        contents=blob_keys.survey_tileset_contents(survey_id),
        progress=lambda share: context.report("exporting", 0.4 + 0.2 * share),
    )


def scoring(report: Progress, *, encoded: bool) -> Progress:
    """Report a detector's stages as one; where the map has to be encoded now, that is half of the work."""

    def progress(stage: str, share: float) -> None:
        half = 0.0 if stage == "encoding" else 0.5
        report("scoring", share if encoded else half + share / 2)

    return progress


def _asked(context: Context) -> tuple[SurveyRecord, VersionRecord, PipelineSettings]:
    """Return the survey of the job, the map that it is compared with, and the settings. Raises DetectorUnavailable."""
    if context.job.survey_id is None:
        raise LookupError(f"job {context.job.job_id} has no survey")
    survey = context.catalog.surveys.get(context.job.survey_id)
    version = context.catalog.versions.get(survey.map_id, survey.map_version)
    return (
        survey,
        version,
        pipeline_settings(context, version, card_that_fits(context, survey.model, version.model)),
    )


def _compared(
    context: Context, survey: SurveyRecord, version: VersionRecord, settings: PipelineSettings
) -> Comparison:
    """Set map and survey side by side, for detectors of all touched tiles with what both visits saw."""
    map_key = functools.partial(blob_keys.map_scan, version.job_id)
    survey_key = functools.partial(blob_keys.survey_scan, survey.survey_id)
    scans = kept_scans(context, survey.scans, survey_key)
    size = settings.registration.voxel_size
    before = now = None
    if settings.tiling.tiles == "touched":
        before = kept_seen(context, version, voxel_size=size)
        now = seen_by(context, blob_keys.survey_seen(survey.survey_id), scans, voxel_size=size)
    return compare(
        kept_reference(context, version),
        _kept_current(context, survey),
        settings=settings,
        reference_scans=kept_scans(context, version.scans, map_key),
        current_scans=scans,
        reference_seen=before,
        current_seen=now,
    )


def _kept_current(context: Context, survey: SurveyRecord) -> CurrentMap:
    key = blob_keys.survey_current(survey.survey_id)
    return load(context, key, functools.partial(npz.load, kind=CurrentMap))


def _object_record(thing: ChangeObject) -> ObjectRecord:
    """Return an object as it is recorded; its score and the motion's overlap are the worker's own affair."""
    now, before = (None if place is None else Place(**asdict(place)) for place in (thing.now, thing.before))
    motion = thing.motion and Motion(translation=thing.motion.translation, yaw=thing.motion.yaw)
    return ObjectRecord(
        number=thing.number,
        kind=thing.kind,
        now=now,
        before=before,
        motion=motion,
        probability=thing.probability,
        observed_share=thing.observed_share,
        scans_seen_through=thing.scans_seen_through,
    )


def _tile_record(result: TileResult) -> TileRecord:
    values = asdict(result)
    lower, upper = values.pop("lower"), values.pop("upper")
    return TileRecord(bounds=Bounds(min=lower, max=upper), **values)
