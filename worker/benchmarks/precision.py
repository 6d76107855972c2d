"""`spicd-worker evaluate precision`: how far a model's scores move where it computes in bfloat16.

Simulated offices are visited twice, the second time with things added, removed and moved; both visits lie at their true
poses. Every tile, and every voxel of models that score these, is scored in float32 and in bfloat16.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rich.table import Table

from worker.benchmarks.documents import titled_table
from worker.benchmarks.timing import processor_name
from worker.cloud.seen import Seen
from worker.cloud.tiling import Tiles, TilingSettings, cut, grid_over, pair_tiles, touched_tiles
from worker.cloud.types import Floats, Points
from worker.detectors.card import MODEL_STORE, Card, PrecisionCheck
from worker.detectors.comparison import Comparison, Side
from worker.detectors.detector import Detection
from worker.detectors.running.runtime import Runtime
from worker.detectors.store import Device, open_detector, resolve_device, write_card
from worker.progress import Progress, no_progress
from worker.simulation.scenes.buildings import small_office
from worker.simulation.sensor import SimulatedScan
from worker.simulation.visits import edited, visit

Kind = Literal["cpu", "cuda"]


@dataclass(frozen=True, kw_only=True, slots=True)
class PrecisionSettings:
    """What is scored."""

    model: str
    model_store: Path = MODEL_STORE
    device: Device = "auto"
    way: Kind | None = (
        None  #: of computing: a GPU's, which any device can, or the processor's, which it alone can; None: the device's own
    )
    offices: int = 3
    scans: int = 6  #: of each visit
    edits: int = 6  #: between both
    seed: int = 1

    @property
    def computes_on(self) -> Device:
        """The device that is used: for the processor's way always the processor, which alone searches in 8 bits."""
        return "cpu" if self.way == "cpu" else self.device


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Placed:
    points: Points
    sensor_origin: Floats | None


def measure(settings: PrecisionSettings, progress: Progress = no_progress) -> PrecisionCheck:
    """Score everything both ways. Raises DetectorUnavailable for a device without bfloat16, and as `open_detector`."""
    device = resolve_device(settings.computes_on)
    at_once = (settings.way or device.type) == "cuda"
    exact, coarse = (
        open_detector(
            settings.model_store,
            settings.model,
            settings.computes_on,
            Runtime(precision=precision, at_once=at_once),
        )
        for precision in ("float32", "bfloat16")
    )
    differences, otherwise, tiles = [0.0], 0, 0
    for comparison in _comparisons(settings, exact.card, progress):
        one, other = exact.detect(comparison), coarse.detect(comparison)
        told = ~np.isnan(one.change)
        differences += [_largest(one.change[told], other.change[told]), *_of_voxels(one, other)]
        threshold = exact.card.threshold
        otherwise += int(((one.change > threshold) != (other.change > threshold))[told].sum())
        tiles += int(told.sum())
    if exact.card.sha256 is None or not tiles:
        raise ValueError(f"model {settings.model} has no network whose precision could be measured")
    name = processor_name() if device.type == "cpu" else _gpu_name()
    return PrecisionCheck(
        largest_score_difference=max(differences),
        decided_otherwise=otherwise,
        tiles=tiles,
        sha256=exact.card.sha256,
        device=name if device.type == (settings.way or device.type) else f"{name}, as a GPU computes",
        data=f"{settings.offices} simulated offices from seed {settings.seed}, {settings.scans} scans a visit, "
        f"{settings.edits} edits",
        command=_command(settings),
    )


def record(settings: PrecisionSettings, check: PrecisionCheck) -> Path:
    """Put a check on the model's card, under the way of computing that was measured; returns the card."""
    folder = settings.model_store / settings.model
    card = Card.model_validate_json((folder / "card.json").read_bytes())
    kind = settings.way or resolve_device(settings.device).type
    write_card(folder, card.model_copy(update={"precision": {**card.precision, kind: check}}))
    return folder / "card.json"


def _command(settings: PrecisionSettings) -> str:
    asked = f"--model {settings.model} --offices {settings.offices} --scans {settings.scans} --seed {settings.seed}"
    return f"spicd-worker evaluate precision {asked}" + (f" --way {settings.way}" if settings.way else "")


def _comparisons(settings: PrecisionSettings, card: Card, progress: Progress) -> Iterator[Comparison]:
    for number in range(settings.offices):
        progress("simulating", number / settings.offices)
        seed = settings.seed + number
        before = small_office(seed)
        after, stops = edited(before, settings.edits, seed=seed, count=settings.scans)
        visits = (visit(before, settings.scans, seed=seed), visit(after, stops, seed=seed + 1))
        size = card.preprocessing.voxel_size
        reference, current = (Seen.of(_placed(scans), voxel_size=size) for scans in visits)
        progress("scoring", number / settings.offices)
        yield _compared(reference, current, card)
    progress("scoring", 1.0)


def _placed(scans: Sequence[SimulatedScan]) -> Iterator[_Placed]:
    for scan in scans:
        yield _Placed(
            points=scan.world_points.astype(np.float32), sensor_origin=scan.world_from_sensor[:3, 3]
        )


def _compared(reference: Seen, current: Seen, card: Card) -> Comparison:
    needs = card.preprocessing
    grid = grid_over(reference.points, tile_size=needs.tile_size, voxel_size=needs.voxel_size)
    if needs.tiles == "touched":
        tiles: Tiles = touched_tiles(reference.points, current.points, grid)
    else:
        tiles = cut(reference.points, grid, min_points=needs.min_points)
    tiling = TilingSettings(tiles=needs.tiles, min_points=needs.min_points)
    return Comparison(
        reference=Side(points=reference.points, seen=reference),
        current=Side(points=current.points, seen=current),
        tile_pairs=pair_tiles(tiles, current.points, settings=tiling),
    )


def _of_voxels(one: Detection, other: Detection) -> list[float]:
    if one.voxels is None or other.voxels is None:
        return []
    return [
        _largest(one.voxels.appeared, other.voxels.appeared),
        _largest(one.voxels.disappeared, other.voxels.disappeared),
    ]


def _largest(a: Floats | np.ndarray, b: Floats | np.ndarray) -> float:
    return float(np.abs(a - b).max(initial=0.0))


def _gpu_name() -> str:
    import torch  # noqa: PLC0415 - only where there is one

    return str(torch.cuda.get_device_name())


def table(check: PrecisionCheck, model: str) -> Table:
    """Show a check on a terminal."""
    rows = (
        ("largest difference of a score", f"{check.largest_score_difference:.1e}"),
        ("tiles decided otherwise", f"{check.decided_otherwise} of {check.tiles}"),
        ("the scores hold", "yes" if check.holds else "no"),
    )
    return titled_table(f"{model} in bfloat16 on {check.device}", ("", ""), rows, caption=check.data)
