"""The shell of each step: load from the catalog, call the pipeline, save, report.

Every step takes the job's id alone and may run twice: it reads what the step before it left, and replaces what
an earlier run of itself left. A step of a job that has ended does nothing.
"""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from service.catalog import keys
from service.catalog.catalog import Catalog, open_catalog
from service.catalog.records import Bounds, JobRecord, MapRecord, Problem, ScanOutcome, TileRecord
from service.settings import Settings
from worker.detectors.card import Card
from worker.detectors.detector import Detector
from worker.detectors.store import open_card, open_detector
from worker.errors import Cancelled, DetectorUnavailable, MapFailed, PipelineError
from worker.pipeline import archive
from worker.pipeline.chaining import Outcome, ScanFile
from worker.pipeline.changes import decide
from worker.pipeline.export import TileResult, tile_results, write_coloured_cloud
from worker.pipeline.flow import NoScanAccepted, PipelineSettings, build_map, locate_survey
from worker.pipeline.manifest import manifest
from worker.pipeline.picture import draw_picture
from worker.pipeline.ply import write_ply
from worker.reporting import Reporter

log = logging.getLogger("worker.jobs")

#: The part of the whole job that each stage takes, by measurement on a 25-scan map and a one-scan survey.
_MAP_STAGES = {
    "registering": (0.0, 0.7),
    "tiling": (0.7, 0.75),
    "saving": (0.75, 0.8),
    "describing": (0.8, 1.0),
}
_SURVEY_STAGES = {
    "registering": (0.0, 0.3),
    "tiling": (0.3, 0.33),
    "saving": (0.33, 0.36),
    "scoring": (0.36, 0.85),
    "exporting": (0.85, 1.0),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class _Context:
    """What a step works with; `scratch` goes with the step."""

    settings: Settings
    catalog: Catalog
    job: JobRecord
    report: Reporter
    scratch: Path


def _step(run: Callable[[_Context], None]) -> Callable[[str], None]:
    """Open the catalog, skip what has ended, and record what goes wrong before rq hears of it."""

    @functools.wraps(run)
    def call(job_id: str) -> None:
        settings = Settings()
        with ExitStack() as stack:
            catalog = open_catalog(settings, migrate=False)
            stack.callback(catalog.close)
            if not catalog.jobs.start(job_id):
                log.info("job %s has ended; nothing to do", job_id)
                return
            job = catalog.jobs.get(job_id)
            scratch = Path(stack.enter_context(TemporaryDirectory(prefix="spicd-step-")))
            report = Reporter(
                _MAP_STAGES if job.kind == "map" else _SURVEY_STAGES,
                lambda stage, share: catalog.jobs.report(job_id, message=stage, progress=share),
            )
            try:
                run(_Context(settings=settings, catalog=catalog, job=job, report=report, scratch=scratch))
            except Cancelled:
                log.info("job %s was dismissed", job_id)
            except PipelineError as error:
                catalog.jobs.fail(job_id, Problem.of(error))
                raise

    return call


@_step
def register_map(at: _Context) -> None:
    """Scans to a fused, tiled map."""
    record = at.catalog.maps.get(at.job.map_id)
    card = open_card(at.settings.model_store, record.model)
    with ExitStack() as stack:
        files = _scan_files(at, record.scans, stack)
        built = build_map(files, settings=_pipeline_settings(at, record, card), progress=at.report)
    at.report("saving", 0.0)
    outcomes = _outcomes(record.scans, built.outcomes)
    at.catalog.maps.save_outcomes(record.map_id, outcomes)
    if not built.tiles.points:
        raise MapFailed(
            f"no tile holds {card.preprocessing.min_points} points of the fused map "
            f"({len(built.reference.points)} points in all); add scans"
        )
    _put(at, keys.map_reference(record.map_id), lambda path: archive.save_reference(path, built.reference))
    _put(at, keys.map_tiles(record.map_id), lambda path: archive.save_tiles(path, built.tiles))
    _put(
        at,
        keys.map_cloud(record.map_id),
        lambda path: write_ply(path, built.reference.points, colors=built.reference.colors),
    )
    _save_scans(at, record.scans, built.outcomes, functools.partial(keys.map_scan, record.map_id))
    listing = manifest(
        built.reference.points,
        built.tiles,
        patch_size=card.preprocessing.patch_points,
        min_points=card.preprocessing.min_points,
        voxel_size=card.preprocessing.voxel_size,
    )
    at.catalog.blobs.put_bytes(keys.map_manifest(record.map_id), json.dumps(listing).encode())
    at.catalog.maps.save_result(
        record.map_id,
        outcomes=outcomes,
        bounds=Bounds.model_validate(listing["map_bounds"]),
        counts={
            "points": len(built.reference.points),
            "tiles": len(built.tiles.points),
            "scans": len(built.outcomes),
            "accepted": sum(outcome.scan is not None for outcome in built.outcomes),
        },
    )


@_step
def describe_map(at: _Context) -> None:
    """What the model can know of the reference alone; then the map is ready."""
    record = at.catalog.maps.get(at.job.map_id)
    detector = _detector(at.settings, record.model)
    with at.catalog.blobs.local(keys.map_tiles(record.map_id)) as path:
        tiles = archive.load_tiles(path)
    description = detector.describe(tiles, progress=lambda _, share: at.report("describing", share))
    key = keys.map_description(record.map_id, record.model)
    _put(at, key, lambda path: archive.save_arrays(path, description))
    at.catalog.jobs.succeed(at.job.job_id)


@_step
def register_survey(at: _Context) -> None:
    """Scans to tiles paired with the map's; a survey with no accepted scan fails here."""
    survey_id = _survey_id(at)
    survey = at.catalog.surveys.get(survey_id)
    record = at.catalog.maps.ready(survey.map_id)
    card = _card_that_fits(at.settings, survey.model, record.model)
    with ExitStack() as stack:
        blobs = at.catalog.blobs
        reference = archive.load_reference(
            stack.enter_context(blobs.local(keys.map_reference(record.map_id)))
        )
        tiles = archive.load_tiles(stack.enter_context(blobs.local(keys.map_tiles(record.map_id))))
        files = _scan_files(at, survey.scans, stack)
        settings = _pipeline_settings(at, record, card)
        try:
            located = locate_survey(files, reference, tiles, settings=settings, progress=at.report)
        except NoScanAccepted as error:
            at.catalog.surveys.save_outcomes(survey_id, _outcomes(survey.scans, error.outcomes))
            raise
    at.report("saving", 0.0)
    at.catalog.surveys.save_outcomes(survey_id, _outcomes(survey.scans, located.outcomes))
    _put(at, keys.survey_current(survey_id), lambda path: archive.save_current(path, located.current))
    _put(at, keys.survey_pairs(survey_id), lambda path: archive.save_pairs(path, located.pairs))
    _save_scans(at, survey.scans, located.outcomes, functools.partial(keys.survey_scan, survey_id))


@_step
def score_survey(at: _Context) -> None:
    """Paired tiles to class probabilities."""
    survey_id = _survey_id(at)
    survey = at.catalog.surveys.get(survey_id)
    detector = _detector(at.settings, survey.model)
    blobs = at.catalog.blobs
    with blobs.local(keys.survey_pairs(survey_id)) as path:
        pairs = archive.load_pairs(path)
    description = None
    key = keys.map_description(survey.map_id, survey.model)
    if blobs.exists(key):
        with blobs.local(key) as path:
            description = archive.load_arrays(path)
    scores = detector.score(
        pairs, description=description, progress=lambda _, share: at.report("scoring", share)
    )
    _put(at, keys.survey_scores(survey_id), lambda path: archive.save_scores(path, scores))


@_step
def export_survey(at: _Context) -> None:
    """Scores to tile states, the coloured cloud and the picture; then the survey is ready."""
    survey_id = _survey_id(at)
    survey = at.catalog.surveys.get(survey_id)
    at.report("exporting", 0.0)
    blobs = at.catalog.blobs
    with ExitStack() as stack:
        local = functools.partial(lambda key: stack.enter_context(blobs.local(key)))
        pairs = archive.load_pairs(local(keys.survey_pairs(survey_id)))
        scores = archive.load_scores(local(keys.survey_scores(survey_id)))
        current = archive.load_current(local(keys.survey_current(survey_id)))
        reference = archive.load_reference(local(keys.map_reference(survey.map_id)))
    card = open_card(at.settings.model_store, survey.model)
    threshold = card.threshold if survey.threshold is None else survey.threshold
    changes = decide(pairs, scores, threshold=threshold)
    _put(at, keys.survey_cloud(survey_id), lambda path: write_coloured_cloud(path, current, changes))
    at.report("exporting", 0.4)
    title = f"Map {survey.map_id}: survey of {survey.captured_at:%Y-%m-%d %H:%M} UTC"
    _put(
        at,
        keys.survey_picture(survey_id),
        lambda path: draw_picture(path, reference.points, current, changes, title=title),
    )
    at.report("exporting", 0.9)
    tiles = [_tile_record(result) for result in tile_results(changes)]
    at.catalog.surveys.save_result(survey_id, tiles=tiles, threshold=threshold)
    at.catalog.jobs.succeed(at.job.job_id)


@functools.lru_cache(maxsize=4)
def _opened(model_store: Path, model: str, device: str) -> Detector:
    return open_detector(model_store, model, device)  # type: ignore[arg-type]  # Settings checked the device


def _detector(settings: Settings, model: str) -> Detector:
    """The network, kept between jobs by the inference worker's process."""
    return _opened(settings.model_store, model, settings.device)


def _card_that_fits(settings: Settings, model: str, map_model: str) -> Card:
    """The survey's model must cut the world as the map was cut."""
    card, built_with = (open_card(settings.model_store, name) for name in (model, map_model))
    ours, theirs = card.preprocessing, built_with.preprocessing
    same = (ours.voxel_size, ours.tile_size, ours.min_points) == (
        theirs.voxel_size,
        theirs.tile_size,
        theirs.min_points,
    )
    if not same:
        raise DetectorUnavailable(
            f"model {model} needs voxels of {ours.voxel_size:g} m and tiles of {ours.tile_size}, the map was "
            f"built for {map_model} with {theirs.voxel_size:g} m and {theirs.tile_size}; build a map for it"
        )
    return card


def _pipeline_settings(at: _Context, record: MapRecord, card: Card) -> PipelineSettings:
    asked = PipelineSettings.model_validate(
        {**record.settings, "max_scan_points": at.settings.max_scan_points}
    )
    return asked.for_model(card.preprocessing)


def _survey_id(at: _Context) -> str:
    if at.job.survey_id is None:
        raise LookupError(f"job {at.job.job_id} has no survey")
    return at.job.survey_id


def _scan_files(at: _Context, scans: Sequence[ScanOutcome], stack: ExitStack) -> list[ScanFile]:
    """The uploads as local files for as long as the stack is open."""
    files = []
    for each in scans:
        scan = at.catalog.scans.get(each.scan_id)
        path = stack.enter_context(at.catalog.blobs.local(scan.key))
        pose = None if scan.pose is None else np.array(scan.pose, np.float64)
        files.append(ScanFile(name=scan.filename, path=path, pose=pose))
    return files


def _outcomes(scans: Sequence[ScanOutcome], outcomes: Sequence[Outcome]) -> list[ScanOutcome]:
    return [
        ScanOutcome(
            scan_id=scan.scan_id,
            accepted=outcome.scan is not None,
            fitness=outcome.fitness,
            rmse=outcome.inlier_rmse,
            map_from_scan=None if outcome.scan is None else outcome.scan.map_from_scan.tolist(),
            reason=outcome.reason,
        )
        for scan, outcome in zip(scans, outcomes, strict=True)
    ]


def _save_scans(
    at: _Context,
    scans: Sequence[ScanOutcome],
    outcomes: Sequence[Outcome],
    key_of: Callable[[str], str],
) -> None:
    for done, (each, outcome) in enumerate(zip(scans, outcomes, strict=True)):
        at.report("saving", done / len(scans))
        scan = outcome.scan
        if scan is not None:
            _put(at, key_of(each.scan_id), functools.partial(archive.save_scan, scan=scan))


def _put(at: _Context, key: str, write: Callable[[Path], None]) -> None:
    """Have a file written aside, then take it into the blob store in one move."""
    path = at.scratch / key.replace("/", "_")
    write(path)
    at.catalog.blobs.put_file(key, path, move=True)


def _tile_record(result: TileResult) -> TileRecord:
    values = asdict(result)
    lower, upper = values.pop("lower"), values.pop("upper")
    return TileRecord(bounds=Bounds(min=lower, max=upper), **values)
