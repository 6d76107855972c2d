"""The steps that compare a survey with its map."""

from __future__ import annotations

import functools
from contextlib import ExitStack
from dataclasses import asdict

from service.catalog import blob_keys
from service.catalog.records import Bounds, SurveyRecord, TileRecord, VersionRecord
from worker.cloud import npz
from worker.detectors.detector import Detection
from worker.jobs.models import card_of, card_that_fits, kept_detector, pipeline_settings
from worker.jobs.scans import kept_scans, save_scans, scan_files, scan_outcomes
from worker.jobs.step import Context, load, put, step
from worker.jobs.versions import kept_reference
from worker.pipeline.flow import NoScanAccepted, compare, locate_survey
from worker.pipeline.mapping.fusion import CurrentMap
from worker.pipeline.results.changes import decide
from worker.pipeline.results.export import TileResult, tile_results, write_coloured_cloud
from worker.pipeline.results.picture import draw_picture
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress


@step
def register_survey(context: Context) -> None:
    """Fuse the scans to one cloud in the map's frame; a survey with no accepted scan fails here."""
    survey, version, settings = _asked(context)
    reference = kept_reference(context, version)
    with ExitStack() as stack:
        files = scan_files(context, survey.scans, stack, settings)
        try:
            located = locate_survey(files, reference, settings=settings, progress=context.report)
        except NoScanAccepted as error:
            context.catalog.surveys.save_outcomes(
                survey.survey_id, scan_outcomes(survey.scans, error.outcomes)
            )
            raise
        key_of = functools.partial(blob_keys.survey_scan, survey.survey_id)
        save_scans(context, survey.scans, files, located.outcomes, key_of)
    context.catalog.surveys.save_outcomes(survey.survey_id, scan_outcomes(survey.scans, located.outcomes))
    put(context, blob_keys.survey_current(survey.survey_id), lambda path: npz.save(path, located.current))


@step
def score_survey(context: Context) -> None:
    """Score the map and the survey side by side: class probabilities."""
    survey, version, settings = _asked(context)
    detector = kept_detector(context, survey.model)
    embedding = None
    key = blob_keys.map_embedding(version.job_id, survey.model, detector.card.fingerprint)
    if context.catalog.blobs.exists(key):
        embedding = load(context, key, npz.load_arrays)
    map_key = functools.partial(blob_keys.map_scan, version.job_id)
    survey_key = functools.partial(blob_keys.survey_scan, survey.survey_id)
    comparison = compare(
        kept_reference(context, version),
        _kept_current(context, survey),
        settings=settings,
        reference_scans=kept_scans(context, version.scans, map_key),
        current_scans=kept_scans(context, survey.scans, survey_key),
    )
    progress = scoring(context.report, encoded=embedding is not None)
    detection = detector.detect(comparison, embedding=embedding, progress=progress)
    put(context, blob_keys.survey_scores(survey.survey_id), lambda path: npz.save(path, detection))


@step
def export_survey(context: Context) -> None:
    """Make of the scores tile states, the coloured cloud and the picture; then the survey is ready."""
    survey, version, settings = _asked(context)
    survey_id = survey.survey_id
    context.report("exporting", 0.0)
    reference, current = kept_reference(context, version), _kept_current(context, survey)
    detection = load(context, blob_keys.survey_scores(survey_id), functools.partial(npz.load, kind=Detection))
    card = card_of(context, survey.model)
    threshold = card.threshold if survey.threshold is None else survey.threshold
    pairs = compare(reference, current, settings=settings).tile_pairs
    changes = decide(pairs, detection, threshold=threshold)
    put(context, blob_keys.survey_cloud(survey_id), lambda path: write_coloured_cloud(path, current, changes))
    context.report("exporting", 0.4)
    title = f"Map {survey.map_id}: survey of {survey.captured_at:%Y-%m-%d %H:%M} UTC"
    put(
        context,
        blob_keys.survey_picture(survey_id),
        lambda path: draw_picture(path, reference.points, current, changes, title=title),
    )
    context.report("exporting", 0.9)
    tiles = [_tile_record(result) for result in tile_results(changes)]
    context.catalog.surveys.save_result(survey_id, tiles=tiles, threshold=threshold)
    context.catalog.jobs.succeed(context.job.job_id)


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


def _kept_current(context: Context, survey: SurveyRecord) -> CurrentMap:
    key = blob_keys.survey_current(survey.survey_id)
    return load(context, key, functools.partial(npz.load, kind=CurrentMap))


def _tile_record(result: TileResult) -> TileRecord:
    values = asdict(result)
    lower, upper = values.pop("lower"), values.pop("upper")
    return TileRecord(bounds=Bounds(min=lower, max=upper), **values)
