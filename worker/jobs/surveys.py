"""The steps that compare a survey with its map."""

from __future__ import annotations

import functools
from contextlib import ExitStack
from dataclasses import asdict

from service.catalog import blob_keys
from service.catalog.records import Bounds, TileRecord
from worker.jobs.models import card_of, card_that_fits, kept_detector, pipeline_settings
from worker.jobs.scans import save_scans, scan_files, scan_outcomes
from worker.jobs.step import Context, put, step
from worker.pipeline import archive
from worker.pipeline.flow import NoScanAccepted, locate_survey
from worker.pipeline.results.changes import decide
from worker.pipeline.results.export import TileResult, tile_results, write_coloured_cloud
from worker.pipeline.results.picture import draw_picture
from worker.progress import Progress


@step
def register_survey(at: Context) -> None:
    """Scans to tiles paired with the map's; a survey with no accepted scan fails here."""
    survey_id = _survey_id(at)
    survey = at.catalog.surveys.get(survey_id)
    record = at.catalog.versions.get(survey.map_id, survey.map_version)
    card = card_that_fits(at, survey.model, record.model)
    with ExitStack() as stack:
        blobs = at.catalog.blobs
        reference = archive.load_reference(
            stack.enter_context(blobs.local(blob_keys.map_reference(record.job_id)))
        )
        tiles = archive.load_tiles(stack.enter_context(blobs.local(blob_keys.map_tiles(record.job_id))))
        files = scan_files(at, survey.scans, stack)
        settings = pipeline_settings(at, record, card)
        try:
            located = locate_survey(files, reference, tiles, settings=settings, progress=at.report)
        except NoScanAccepted as error:
            at.catalog.surveys.save_outcomes(survey_id, scan_outcomes(survey.scans, error.outcomes))
            raise
        key_of = functools.partial(blob_keys.survey_scan, survey_id)
        save_scans(at, survey.scans, files, located.outcomes, key_of)
    at.catalog.surveys.save_outcomes(survey_id, scan_outcomes(survey.scans, located.outcomes))
    put(at, blob_keys.survey_current(survey_id), lambda path: archive.save_current(path, located.current))
    put(at, blob_keys.survey_pairs(survey_id), lambda path: archive.save_pairs(path, located.pairs))


@step
def score_survey(at: Context) -> None:
    """Paired tiles to class probabilities."""
    survey_id = _survey_id(at)
    survey = at.catalog.surveys.get(survey_id)
    detector = kept_detector(at, survey.model)
    blobs = at.catalog.blobs
    with blobs.local(blob_keys.survey_pairs(survey_id)) as path:
        pairs = archive.load_pairs(path)
    description = None
    built_by = at.catalog.versions.get(survey.map_id, survey.map_version).job_id
    key = blob_keys.map_embedding(built_by, survey.model, detector.card.sha256)
    if blobs.exists(key):
        with blobs.local(key) as path:
            description = archive.load_arrays(path)
    progress = scoring(at.report, described=description is not None)
    scores = detector.score(pairs, description=description, progress=progress)
    put(at, blob_keys.survey_scores(survey_id), lambda path: archive.save_scores(path, scores))


@step
def export_survey(at: Context) -> None:
    """Scores to tile states, the coloured cloud and the picture; then the survey is ready."""
    survey_id = _survey_id(at)
    survey = at.catalog.surveys.get(survey_id)
    at.report("exporting", 0.0)
    blobs = at.catalog.blobs
    with ExitStack() as stack:
        local = functools.partial(lambda key: stack.enter_context(blobs.local(key)))
        pairs = archive.load_pairs(local(blob_keys.survey_pairs(survey_id)))
        scores = archive.load_scores(local(blob_keys.survey_scores(survey_id)))
        current = archive.load_current(local(blob_keys.survey_current(survey_id)))
        built_by = at.catalog.versions.get(survey.map_id, survey.map_version).job_id
        reference = archive.load_reference(local(blob_keys.map_reference(built_by)))
    card = card_of(at, survey.model)
    threshold = card.threshold if survey.threshold is None else survey.threshold
    changes = decide(pairs, scores, threshold=threshold)
    put(at, blob_keys.survey_cloud(survey_id), lambda path: write_coloured_cloud(path, current, changes))
    at.report("exporting", 0.4)
    title = f"Map {survey.map_id}: survey of {survey.captured_at:%Y-%m-%d %H:%M} UTC"
    put(
        at,
        blob_keys.survey_picture(survey_id),
        lambda path: draw_picture(path, reference.points, current, changes, title=title),
    )
    at.report("exporting", 0.9)
    tiles = [_tile_record(result) for result in tile_results(changes)]
    at.catalog.surveys.save_result(survey_id, tiles=tiles, threshold=threshold)
    at.catalog.jobs.succeed(at.job.job_id)


def scoring(report: Progress, *, described: bool) -> Progress:
    """A model that did not describe the map does so now, which is half of the work."""

    def progress(stage: str, share: float) -> None:
        half = 0.0 if stage == "describe" else 0.5
        report("scoring", share if described else half + share / 2)

    return progress


def _survey_id(at: Context) -> str:
    if at.job.survey_id is None:
        raise LookupError(f"job {at.job.job_id} has no survey")
    return at.job.survey_id


def _tile_record(result: TileResult) -> TileRecord:
    values = asdict(result)
    lower, upper = values.pop("lower"), values.pop("upper")
    return TileRecord(bounds=Bounds(min=lower, max=upper), **values)
