"""A trial: one experiment carried out, up to the tile pairs that methods are given (paper, Section 4.2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from worker.benchmarks.paper.experiment import Experiment
from worker.benchmarks.paper.injection import Injection, Trace, inject
from worker.benchmarks.paper.site import Site
from worker.cloud.formats.scan import Scan
from worker.cloud.poses import inverse, transformed
from worker.cloud.tiling import TilePairs, pair_tiles
from worker.cloud.types import Bools, Points
from worker.cloud.voxels import Voxels, merged_in_order
from worker.pipeline.registration.preprocessing import prepare
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.scan_to_map import register
from worker.progress import Progress


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Trial:
    """What methods have to tell apart, and the truth."""

    experiment: Experiment
    pairs: TilePairs
    truth: Bools  #: (T,) tiles that were modified
    traces: tuple[Trace, ...]  #: what was changed in them
    current: Points  #: (M, 3) float32, the current map, map frame
    left_out: int  #: modified scans that could not be registered again


def trials(
    site: Site, experiments: Sequence[Experiment], progress: Progress, *, everywhere: bool = False
) -> Iterator[Trial]:
    """One after the other; each holds some ten megabytes."""
    for number, experiment in enumerate(experiments):
        progress(f"{site.name}: {experiment.name}", number / len(experiments))
        yield _carried_out(site, experiment, inject(site, experiment, number, everywhere=everywhere))


def _carried_out(site: Site, experiment: Experiment, injection: Injection) -> Trial:
    changed = {scan: _voxels(site, scan, points) for scan, points in injection.scans.items()}
    every = [changed.get(scan, voxels) for scan, voxels in enumerate(site.voxels)]
    current = merged_in_order([voxels for voxels in every if voxels is not None]).points
    return Trial(
        experiment=experiment,
        pairs=pair_tiles(site.tiles, current, settings=site.settings.tiling),
        truth=injection.truth,
        traces=injection.traces,
        current=current,
        left_out=sum(voxels is None for voxels in every),
    )


def _voxels(site: Site, scan: int, points: Points) -> Voxels | None:
    """A modified scan (n, 3), map frame, as it comes into the current map; None where it is not accepted.

    It is registered to the map again, from where it stood, unless poses are to be true ones.
    """
    size = site.settings.registration.voxel_size
    if site.surface is None:
        return Voxels.of(points, size=size)
    own = transformed(points, inverse(site.poses[scan])).astype(np.float32)
    read = Scan(name=f"scan {scan}", points=own, colors=None, sensor_pose=np.eye(4), n_dropped=0)
    settings = site.settings.registration
    try:
        hypothesis = register(
            prepare(read, settings), site.surface, prior=site.poses[scan], settings=settings
        )
    except ScanRejected:
        return None
    return Voxels.of(transformed(own, hypothesis.target_from_source).astype(np.float32), size=size)
