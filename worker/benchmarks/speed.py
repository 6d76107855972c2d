"""`make bench`: seconds in each stage of a map and of a survey, and what scoring the tiles costs.

A simulated corridor of 25 scans with about 100,000 points each.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from rich.console import Group
from rich.table import Table
from scipy.spatial import cKDTree

from worker.benchmarks.baselines import CloudToCloudBaseline
from worker.benchmarks.documents import Document, pose_spread, shown, spread, titled_table
from worker.benchmarks.methods import TileScore, change_scores, encode_reference, open_model, tile_scores
from worker.benchmarks.timing import StageClock, machine
from worker.benchmarks.trajectory import map_frame, placed_scans, scan_files
from worker.cloud import npz
from worker.cloud.poses import transformed
from worker.cloud.seen import Seen
from worker.cloud.sight import Sights
from worker.cloud.tiling import TilePairs, TilingSettings, pair_tiles, touched_tiles
from worker.cloud.types import Arrays, Floats, Matrix4, Points
from worker.cloud.voxel_keys import packed, unpacked
from worker.cloud.voxels import Voxels
from worker.detectors.card import MODEL_STORE
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detector
from worker.pipeline import archive
from worker.pipeline.flow import (
    BuiltMap,
    NoScanAccepted,
    build_map,
    compare,
    locate_survey,
)
from worker.pipeline.mapping.fusion import CurrentMap
from worker.pipeline.registration.results import ScanFile
from worker.pipeline.results.changes import decide
from worker.pipeline.results.export import tile_results, write_coloured_cloud
from worker.pipeline.results.objects import change_objects
from worker.pipeline.results.picture import draw_picture
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress
from worker.simulation.scenes import corridor
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit
from worker.threads import query_threads

PAPER_TILES = 172  # of the paper's map; its GTX 1650 takes 22.4 s for them (Table 6)
COPIES = (1, 3, 10)  #: of the building, for `scaling`
YARDSTICK = "c2c"  #: what the others are held against: nearest distances by a k-d tree, no training


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchSettings:
    """What is simulated."""

    scans: int = 25
    seed: int = 1
    prior_error: tuple[float, float] = (0.1, 2.0)  #: sigma of the odometry, metres and degrees
    tiles: int = PAPER_TILES  #: that are scored
    repeats: int = 3  #: of each way of scoring, in turn
    model_store: Path = MODEL_STORE
    model: str = "voxel-net/1"


def bench(settings: BenchSettings, progress: Progress = no_progress) -> Document:
    """Run everything once and return the figures, JSON-ready; seconds unless the name says otherwise."""
    detector = open_model(settings.model_store, settings.model)
    pipeline = PipelineSettings().for_model(detector.card.preprocessing)
    by_voxels = pipeline.tiling.tiles == "touched"
    with TemporaryDirectory(prefix="spicd-bench-") as name:
        folder = Path(name)
        progress("simulating", 0.0)
        first, second = (simulated_visit(settings, number, folder) for number in range(2))
        clock = StageClock(progress)
        files = scan_files(first)
        built = build_map(files, settings=pipeline, progress=clock)
        clock("encode", 0.0)
        embedding = encode_reference(detector, built.tiles)
        seen = built.seen if by_voxels else None
        map_seconds = clock.seconds()
        frame = map_frame(built.outcomes, first)
        progress("one-scan survey", 0.0)
        one = scan_files(second)[settings.scans // 2]
        with_prior, without = (
            _survey(file, built, seen, embedding, detector, pipeline, folder)
            for file in (one, replace(one, pose=None))
        )
        pairs = full_visit(second, built, frame)
        rows: list[Document] = []
        if seen is None:
            pairs = resized(pairs, settings.tiles)
            runs = ways(pairs, detector)
        else:
            comparison = full_comparison(second, built, frame, seen, pipeline)
            runs, rows = voxel_ways(pairs, comparison, detector), scaling(comparison, detector, progress)
        scoring = scoring_bench(pairs, runs, repeats=settings.repeats, progress=progress)
    errors = [scan.error for scan in placed_scans(built.outcomes, first, frame)]
    return {
        "machine": machine(
            cores=torch.get_num_threads(),
            torch=torch.__version__,
            device="cuda" if torch.cuda.is_available() else "cpu",
        ),
        "scene": {
            "scans": len(first),
            "points_per_scan": round(float(np.mean([len(scan.points) for scan in first]))),
            "map_points": len(built.reference.points),
            "tiles": len(built.tiles.points),
        },
        "map": map_seconds,
        "map_poses": {"accepted": len(errors), "of": len(first), **pose_spread(errors, "median", "most")},
        "survey_with_prior": with_prior,
        "survey_without_prior": without,
        "network": scoring,
        "scaling": rows,
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def simulated_visit(settings: BenchSettings, number: int, folder: Path) -> tuple[SimulatedScan, ...]:
    return visit(
        corridor(settings.seed),
        settings.scans,
        seed=settings.seed + number,
        prior_error=settings.prior_error,
        folder=folder,
        name=f"visit-{number}-{{:02d}}",
    )


def _survey(
    file: ScanFile,
    built: BuiltMap,
    seen: Seen | None,
    embedding: Arrays,
    detector: Detector,
    settings: PipelineSettings,
    folder: Path,
) -> Document:
    """Time a survey of one scan from file to files, as the jobs run it."""
    npz.save(folder / "reference.npz", built.reference)
    clock = StageClock(no_progress)
    clock("load map", 0.0)
    reference = archive.load_reference(folder / "reference.npz")
    try:
        survey = locate_survey([file], reference, settings=settings, progress=clock)
    except NoScanAccepted as refused:
        return {"rejected": str(refused), **clock.seconds()}
    comparison = survey.comparison
    if seen is not None:
        comparison = compare(
            reference, survey.current, settings=settings, reference_seen=seen, current_seen=survey.seen
        )
    clock("score", 0.0)
    scores = tile_scores(detector, comparison, embedding)
    if scores.voxels is not None:
        clock("objects", 0.0)
        change_objects(comparison, scores.voxels)
    clock("decide and export", 0.0)
    changes = decide(comparison.tile_pairs, scores, threshold=detector.card.threshold)
    write_coloured_cloud(folder / "cloud.ply", reference.points, survey.current.points, changes)
    tile_results(changes)
    clock("picture", 0.0)
    draw_picture(folder / "picture.png", reference.points, survey.current.points, changes, title="bench")
    return {"observed_tiles": int(comparison.observed.sum()), **clock.seconds()}


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _TruePlaced:
    """A scan at its true pose."""

    points: Points
    sensor_origin: Floats


def full_comparison(
    scans: tuple[SimulatedScan, ...],
    built: BuiltMap,
    map_from_world: Matrix4,
    seen: Seen,
    settings: PipelineSettings,
) -> Comparison:
    """Set the second visit, at its true poses, beside the map, with what both saw."""
    poses = [map_from_world @ scan.world_from_sensor for scan in scans]
    placed = (
        _TruePlaced(points=transformed(scan.points, pose).astype(np.float32), sensor_origin=pose[:3, 3])
        for scan, pose in zip(scans, poses, strict=True)
    )
    current = Seen.of(placed, voxel_size=built.reference.voxel_size)
    return compare(
        built.reference,
        CurrentMap(points=current.points, colors=None),
        settings=settings,
        reference_seen=seen,
        current_seen=current,
    )


def full_visit(scans: tuple[SimulatedScan, ...], built: BuiltMap, map_from_world: Matrix4) -> TilePairs:
    """Pair the second visit, at its true poses, with the map, so that nearly every tile is observed."""
    points = np.concatenate([scan.world_points for scan in scans])
    fused = Voxels.of(transformed(points, map_from_world), size=built.reference.voxel_size)
    return pair_tiles(built.tiles, fused.points, settings=PipelineSettings().tiling)


def scoring_bench(
    pairs: TilePairs,
    runs: Mapping[str, Callable[[], TileScore]],
    *,
    repeats: int,
    progress: Progress = no_progress,
) -> Document:
    """Run each way of scoring `repeats` times, in turn; JSON-ready, seconds for all pairs.

    On a shared machine seconds are worth little by themselves, so all ways run in one go and are given as ratios too.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    scores: dict[str, TileScore] = {}
    for turn in range(repeats):
        for number, (name, run) in enumerate(runs.items()):
            progress(f"scoring, {name}", (turn + number / len(runs)) / repeats)
            begun = time.perf_counter()
            scores[name] = run()
            seconds[name].append(time.perf_counter() - begun)
    yardstick = float(np.median(seconds[YARDSTICK]))
    return {
        "tiles": len(pairs.observed),
        "distinct_points_per_tile": round(float(np.mean([len(points) for points in pairs.current]))),
        "seconds": {name: spread(values, "median", "least", "most") for name, values in seconds.items()},
        "times_c2c": {
            name: round(float(np.median(values)) / yardstick, 2) for name, values in seconds.items()
        },
        "largest_score_difference": (
            float(np.nanmax(np.abs(scores["cached"] - scores["uncached"]))) if "cached" in scores else None
        ),
    }


def ways(pairs: TilePairs, detector: Detector) -> dict[str, Callable[[], TileScore]]:
    """Return the yardstick, and the detector without and with the reference embedding that a map keeps."""
    embedding = encode_reference(detector, pairs.reference)
    return {
        YARDSTICK: lambda: CloudToCloudBaseline().score(pairs),
        "uncached": lambda: change_scores(detector, pairs),
        "cached": lambda: change_scores(detector, pairs, embedding),
    }


def voxel_ways(
    pairs: TilePairs, comparison: Comparison, detector: Detector
) -> dict[str, Callable[[], TileScore]]:
    """Return the yardstick on the same clouds, and a detector by voxels from both clouds to tiles and objects."""

    def by_voxels() -> TileScore:
        return told_by_voxels(side_by_side(comparison), detector)

    return {YARDSTICK: lambda: CloudToCloudBaseline().score(pairs), "voxels": by_voxels}


def side_by_side(comparison: Comparison) -> Comparison:
    """Cut both clouds along the tiles that either touched, as `compare` does."""
    reference, current = comparison.reference.points, comparison.current.points
    tiles = touched_tiles(reference, current, comparison.grid)
    pairs = pair_tiles(tiles, current, settings=TilingSettings(tiles="touched", min_points=1))
    return replace(comparison, tile_pairs=pairs)


def told_by_voxels(comparison: Comparison, detector: Detector) -> TileScore:
    detection = tile_scores(detector, comparison)
    if detection.voxels is not None:
        change_objects(comparison, detection.voxels)
    return detection.change


def scaling(comparison: Comparison, detector: Detector, progress: Progress = no_progress) -> list[Document]:
    """Time a detector by voxels and the yardstick on a map laid side by side with itself so many times; JSON-ready.

    The cost of each voxel should stay as it is while the map grows. Peak memory is of the whole process so far.
    """
    rows = []
    for copies in COPIES:
        progress(f"scaling, {copies} times the map", 0.0)
        both = [
            repeated(side.seen, copies) for side in (comparison.reference, comparison.current) if side.seen
        ]
        sides = [Side(points=seen.points, seen=seen) for seen in both]
        wide = replace(comparison, reference=sides[0], current=sides[1])
        begun = time.perf_counter()
        told_by_voxels(side_by_side(wide), detector)
        told = time.perf_counter()
        for one, other in (both, both[::-1]):
            cKDTree(one.points).query(other.points, workers=query_threads())
        ended = time.perf_counter()
        voxels = sum(len(seen.keys) for seen in both)
        rows.append(
            {
                "copies": copies,
                "voxels": voxels,
                "seconds": told - begun,
                "microseconds_per_voxel": 1e6 * (told - begun) / voxels,
                "times_c2c": (told - begun) / (ended - told),
                "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
            }
        )
    return rows


def repeated(seen: Seen, copies: int) -> Seen:
    """Return what would be seen in so many equal buildings side by side along x."""
    apart = int(np.ceil(np.ptp(seen.points[:, 0]) / seen.voxel_size)) + 100  # voxels
    cells = unpacked(seen.keys)
    steps = [np.array([number * apart, 0, 0]) for number in range(copies)]
    sights = seen.sights
    return Seen(
        voxel_size=seen.voxel_size,
        keys=np.concatenate([packed(cells + step) for step in steps]),
        points=np.concatenate([seen.points + (step * seen.voxel_size).astype(np.float32) for step in steps]),
        hits=np.tile(seen.hits, copies),
        sights=None
        if sights is None
        else Sights(
            origins=np.concatenate([sights.origins + step * seen.voxel_size for step in steps]),
            nearest=np.tile(sights.nearest, (copies, 1)),
            farthest=np.tile(sights.farthest, (copies, 1)),
        ),
    )


def resized(pairs: TilePairs, count: int) -> TilePairs:
    """Return `count` observed pairs, the first ones or some twice."""
    return pairs.subset(np.resize(np.flatnonzero(pairs.observed), count))


def tables(figures: Document) -> Group:
    """Show the seconds of each stage and each way of scoring on a terminal."""
    scene, poses = figures["scene"], figures["map_poses"]
    title = f"{scene['scans']} scans of {scene['points_per_scan']:,} points, {scene['tiles']} tiles"
    head = ("seconds of a stage", "map", "survey, drifted prior", "survey, no prior")
    columns = [figures["map"], figures["survey_with_prior"], figures["survey_without_prior"]]
    names = {name: None for column in columns for name, value in column.items() if isinstance(value, float)}
    order = [*(name for name in names if name != "total"), "total"]
    rows = ((name, *(shown(column.get(name), ".2f") for column in columns)) for name in order)
    return Group(
        titled_table(title, head, rows),
        _scoring_table(figures["network"]),
        *([_scaling_table(figures["scaling"])] if figures["scaling"] else []),
        f"scans placed: {poses['accepted']} of {poses['of']}, off by {poses['centimetres']['median']:.1f} cm "
        f"(most {poses['centimetres']['most']:.1f}) and {poses['degrees']['median']:.2f} degrees "
        f"(most {poses['degrees']['most']:.2f})",
        f"peak memory {figures['peak_memory_mb']} MB",
    )


def _scaling_table(rows: Sequence[Document]) -> Table:
    head = ("voxels of both", "seconds", "microseconds a voxel", "times C2C", "peak memory (MB)")
    shown_rows = (
        (
            f"{row['voxels']:,}",
            f"{row['seconds']:.2f}",
            f"{row['microseconds_per_voxel']:.2f}",
            f"{row['times_c2c']:.2f}",
            f"{row['peak_memory_mb']}",
        )
        for row in rows
    )
    return titled_table("the same building side by side, once each", head, shown_rows)


def _scoring_table(scoring: Document) -> Table:
    title = f"{scoring['tiles']} tiles, {scoring['distinct_points_per_tile']} distinct points each"
    names = {
        "c2c": "C2C by k-d tree",
        "uncached": "detector",
        "cached": "detector, map encoded before",
        "voxels": "detector by voxels, with objects",
    }
    rows = (
        (
            names[name],
            f"{seconds['median']:.2f}",
            f"{seconds['least']:.2f} to {seconds['most']:.2f}",
            f"{scoring['times_c2c'][name]:.1f}",
        )
        for name, seconds in scoring["seconds"].items()
    )
    off = scoring["largest_score_difference"]
    difference = None if off is None else f"largest difference between the detector's scores: {off:.1e}"
    head = ("scoring", "seconds (median)", "least to most", "times C2C")
    return titled_table(title, head, rows, caption=difference)
