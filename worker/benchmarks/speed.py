"""`make bench`: seconds in each stage of a map and of a survey, and what the network costs.

A simulated corridor of 25 scans with about 100,000 points each.
"""

from __future__ import annotations

import json
import platform
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from worker.cloud import npz
from worker.cloud.formats.pcd import write_pcd
from worker.cloud.poses import difference
from worker.cloud.tiling import TilePairs, Tiles, grid_over, pair_tiles
from worker.cloud.types import Arrays, Matrix4
from worker.cloud.voxels import Voxels
from worker.detectors.card import MODEL_STORE
from worker.detectors.comparison import Comparison, side_of
from worker.detectors.detector import Detector
from worker.detectors.store import open_detector
from worker.pipeline import archive
from worker.pipeline.flow import compare
from worker.pipeline.mapping.frame import fitted
from worker.pipeline.mapping.fusion import ReferenceMap, current_map, fuse, reference_map
from worker.pipeline.mapping.map_registration import register_map_scans
from worker.pipeline.mapping.survey_registration import register_survey_scans
from worker.pipeline.registration.results import ScanFile, ScanResult, placed
from worker.pipeline.results.changes import decide
from worker.pipeline.results.export import tile_results, write_coloured_cloud
from worker.pipeline.results.picture import draw_picture
from worker.pipeline.settings import PipelineSettings
from worker.progress import Progress, no_progress
from worker.simulation.scenes import corridor
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import visit

PAPER_TILES = 172  # of the paper's map; its GTX 1650 takes 22.4 s for them (Table 6)


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchSettings:
    """What is simulated."""

    scans: int = 25
    seed: int = 1
    prior_error: tuple[float, float] = (0.1, 2.0)  #: sigma of the odometry, metres and degrees
    tiles: int = PAPER_TILES  #: that the network is timed on
    repeats: int = 3  #: of each way of running the network, in turn
    model_store: Path = MODEL_STORE
    model: str = "spicd-net/1"


@dataclass(slots=True)
class Stopwatch:
    """Seconds by stage, in the order they were run."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what runs within; a name that comes back adds up."""
        begun = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begun


def bench(settings: BenchSettings, progress: Progress = no_progress) -> dict[str, Any]:
    """Run everything once and return the figures, JSON-ready; seconds unless the name says otherwise."""
    detector = open_detector(settings.model_store, settings.model)
    pipeline = PipelineSettings().for_model(detector.card.preprocessing)
    with TemporaryDirectory(prefix="spicd-bench-") as folder:
        scratch = Path(folder)
        progress("simulating", 0.0)
        scene = corridor(settings.seed)
        first = visit(scene, settings.scans, seed=settings.seed, prior_error=settings.prior_error)
        second = visit(scene, settings.scans, seed=settings.seed + 1, prior_error=settings.prior_error)
        files = [_written(scratch / f"map-{number}.pcd", scan) for number, scan in enumerate(first)]
        built = _map(files, detector, pipeline, progress)
        one = _written(scratch / "survey.pcd", second[settings.scans // 2])
        progress("one-scan survey", 0.0)
        with_prior = _survey(one, built, detector, pipeline, scratch)
        without = _survey(replace(one, pose=None), built, detector, pipeline, scratch)
        pairs = resized(_full_visit(second, first, built), settings.tiles)
        network = network_bench(pairs, detector, repeats=settings.repeats, progress=progress)
    return {
        "machine": _machine(),
        "scene": {
            "scans": len(first),
            "points_per_scan": round(float(np.mean([len(scan.points) for scan in first]))),
            "map_points": len(built.reference.points),
            "tiles": len(built.tiles.points),
        },
        "map": built.seconds | {"total": sum(built.seconds.values())},
        "map_poses": _pose_errors(first, built.outcomes, built.map_from_world(first)),
        "survey_with_prior": with_prior,
        "survey_without_prior": without,
        "network": network,
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


@dataclass(frozen=True, kw_only=True, slots=True)
class _Built:
    reference: ReferenceMap
    tiles: Tiles
    embedding: Arrays
    outcomes: tuple[ScanResult, ...]
    seconds: dict[str, float]

    def map_from_world(self, scans: tuple[SimulatedScan, ...]) -> Matrix4:
        """By all scans together: a map has the frame of the priors, which drifted."""
        pairs = [
            (scan.world_from_sensor, outcome.placement.map_from_scan)
            for scan, outcome in zip(scans, self.outcomes, strict=True)
            if outcome.placement
        ]
        return fitted([world for world, _ in pairs], [found for _, found in pairs])


def _written(path: Path, scan: SimulatedScan) -> ScanFile:
    write_pcd(path, scan.points)
    return ScanFile(name=path.name, path=path, pose=scan.prior)


def _map(files: list[ScanFile], detector: Detector, settings: PipelineSettings, progress: Progress) -> _Built:
    watch = Stopwatch()
    with watch.stage("read and register"):
        outcomes = register_map_scans(files, settings=settings.multi_scan, progress=progress).outcomes
    with watch.stage("read and fuse"):
        accepted = (
            placed(file, outcome.placement, max_points=settings.max_scan_points)
            for file, outcome in zip(files, outcomes, strict=True)
            if outcome.placement
        )
        fused = fuse(accepted, voxel_size=settings.registration.voxel_size)
    with watch.stage("normals"):
        grid = grid_over(fused.points, tile_size=settings.tiling.tile_size, voxel_size=fused.size)
        reference = reference_map(fused, grid=grid, settings=settings.registration)
    with watch.stage("tile"):
        tiles = reference.tiles(min_points=settings.tiling.min_points)
    with watch.stage("encode"):
        embedding = detector.encode_reference(side_of(tiles), tiles, progress=progress)
    return _Built(
        reference=reference,
        tiles=tiles,
        embedding=embedding,
        outcomes=outcomes,
        seconds=watch.seconds,
    )


def _survey(
    file: ScanFile, built: _Built, detector: Detector, settings: PipelineSettings, scratch: Path
) -> dict[str, Any]:
    """A survey of one scan from file to files, as the jobs run it."""
    watch = Stopwatch()
    npz.save(scratch / "reference.npz", built.reference)
    with watch.stage("load map"):
        reference = archive.load_reference(scratch / "reference.npz")
        surface = reference.surface()
    with watch.stage("read and register"):
        (outcome,) = register_survey_scans([file], surface, settings=settings.multi_scan)
    if outcome.placement is None:
        return {"rejected": outcome.reason, **watch.seconds}
    with watch.stage("fuse and tile"):
        scan = placed(file, outcome.placement, max_points=settings.max_scan_points)
        current = current_map([scan], voxel_size=reference.voxel_size)
        comparison = compare(reference, current, settings=settings)
    with watch.stage("score"):
        detection = detector.detect(comparison, embedding=built.embedding)
    with watch.stage("decide and export"):
        changes = decide(comparison.tile_pairs, detection, threshold=detector.card.threshold)
        write_coloured_cloud(scratch / "cloud.ply", current, changes)
        tile_results(changes)
    with watch.stage("picture"):
        draw_picture(scratch / "picture.png", reference.points, current, changes, title="bench")
    total = sum(watch.seconds.values())
    return {"observed_tiles": int(comparison.observed.sum()), **watch.seconds, "total": total}


def _full_visit(
    second: tuple[SimulatedScan, ...], first: tuple[SimulatedScan, ...], built: _Built
) -> TilePairs:
    """The second visit at its true poses, so that nearly every tile is observed."""
    map_from_world = built.map_from_world(first)
    points = np.concatenate([scan.world_points for scan in second])
    moved = points @ map_from_world[:3, :3].T + map_from_world[:3, 3]
    fused = Voxels.of(moved, size=built.reference.voxel_size)
    return pair_tiles(built.tiles, fused.points, settings=PipelineSettings().tiling)


def _pose_errors(
    scans: tuple[SimulatedScan, ...], outcomes: tuple[ScanResult, ...], map_from_world: Matrix4
) -> dict[str, Any]:
    off = [
        difference(outcome.placement.map_from_scan, map_from_world @ scan.world_from_sensor)
        for scan, outcome in zip(scans, outcomes, strict=True)
        if outcome.placement
    ]
    metres, radians = np.array(off).T
    return {
        "accepted": len(off),
        "of": len(scans),
        "centimetres": {"median": float(np.median(metres) * 100), "most": float(metres.max() * 100)},
        "degrees": {
            "median": float(np.degrees(np.median(radians))),
            "most": float(np.degrees(radians.max())),
        },
    }


def _machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "device": "cuda" if torch.cuda.is_available() else "cpu",
    }


def save(figures: dict[str, Any], path: Path) -> None:
    """Write the figures as JSON, aside and renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".tmp")
    aside.write_text(json.dumps(figures, indent=2) + "\n")
    aside.replace(path)


PLAIN = "uncached"  #: what the others are held against

Way = Callable[[], NDArray[np.float32]]  #: to (T, 3) probabilities


def network_bench(
    pairs: TilePairs, detector: Detector, *, repeats: int, progress: Progress = no_progress
) -> dict[str, Any]:
    """Run each way `repeats` times, in turn; JSON-ready, seconds for all pairs.

    On a shared machine seconds are worth little by themselves, so all ways run in one go and are given as ratios too.
    """
    every = ways(pairs, detector)
    seconds: dict[str, list[float]] = {name: [] for name in every}
    scores: dict[str, NDArray[np.float32]] = {}
    for turn in range(repeats):
        for number, (name, run) in enumerate(every.items()):
            progress(f"network, {name}", (turn + number / len(every)) / repeats)
            begun = time.perf_counter()
            scores[name] = run()
            seconds[name].append(time.perf_counter() - begun)
    plain = float(np.median(seconds[PLAIN]))
    return {
        "tiles": len(pairs.observed),
        "distinct_points_per_tile": round(float(np.mean([len(points) for points in pairs.current]))),
        "seconds": {name: _spread(values) for name, values in seconds.items()},
        "times_faster_than_uncached": {
            name: round(plain / float(np.median(values)), 1) for name, values in seconds.items()
        },
        "largest_score_difference": max(
            float(np.nanmax(np.abs(found - scores[PLAIN]))) for found in scores.values()
        ),
    }


def ways(pairs: TilePairs, detector: Detector) -> dict[str, Way]:
    """The slowest first; each spares something that the one before does not."""
    comparison = Comparison.of_tiles(pairs)
    embedding = detector.encode_reference(comparison.reference, pairs.reference)
    return {
        PLAIN: lambda: detector.detect(comparison).probabilities,
        "cached": lambda: detector.detect(comparison, embedding=embedding).probabilities,
    }


def resized(pairs: TilePairs, count: int) -> TilePairs:
    """`count` observed pairs, the first ones or some twice."""
    chosen = np.resize(np.flatnonzero(pairs.observed), count)
    reference = pairs.reference
    return TilePairs(
        reference=replace(
            reference,
            indices=reference.indices[chosen],
            points=tuple(reference.points[tile] for tile in chosen),
        ),
        current=tuple(pairs.current[tile] for tile in chosen),
        observed=np.ones(count, bool),
    )


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": float(np.median(values)), "least": min(values), "most": max(values)}
