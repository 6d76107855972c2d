"""Registration of one scan to a map: where it was taken (paper, Section 3.3.2 and Table 1)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from worker.cloud.poses import exponential, transformed
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.registration.bev_correlation import bev_candidates
from worker.pipeline.registration.fpfh_ransac import fpfh_candidates
from worker.pipeline.registration.hypothesis import Hypothesis, better
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.refinement import Refinement, by_score, coarse_alignment
from worker.pipeline.registration.results import RegistrationResult
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import (
    require_accepted,
    require_constrained,
    require_unambiguous,
)

_BEV_CANDIDATES = 12  # that the bird's-eye views name
_BEST_CANDIDATES = 4  # of those that get a full ICP
_WORTH = 0.3  # coarse score of an FPFH candidate that gets one; right ones have 0.5 and more


def register(
    scan: PreparedScan,
    target: Surface,
    *,
    prior: Matrix4 | None = None,
    settings: RegistrationSettings,
    tick: Callable[[], None] = lambda: None,
) -> Hypothesis:
    """Find target_from_source by ICP from the prior of it, then by global registration where that does not do.

    Table 1 alone accepts wrong poses (a room laid over the next one reaches fitness 0.60) and refuses true ones
    of sparse scans (0.48). So both clouds must lie on common surfaces, seen from either side, over half of the
    scan or with Table 1's fitness. A pose near a given prior needs less of it; one far from it is not taken,
    because buildings repeat themselves. See docs/decisions.

    Raises ScanRejected with the best numbers reached, or where what is shared cannot hold a pose.
    """
    refinement = Refinement(source=scan.surface, target=target, prior=prior, settings=settings, tick=tick)
    hypothesis = None if prior is None else refinement.from_prior(prior)
    if hypothesis is None or not hypothesis.is_accepted(settings):
        hypothesis = global_registration(refinement, hypothesis)
    require_accepted(scan.name, hypothesis, settings)
    hypothesis = best_quarter_turn(refinement, hypothesis)
    require_constrained(scan.name, scan.surface, target, hypothesis, settings)
    around = replace(refinement.narrow(), prior=hypothesis.target_from_source, tick=lambda: None)
    require_unambiguous(scan.name, hypothesis, around.from_start, settings)
    return refinement.final(hypothesis)


def global_registration(refinement: Refinement, best: Hypothesis | None) -> Hypothesis:
    """Refine what the global search names until one is clearly accepted; `best` is what was there before it."""
    settings = refinement.settings
    for start in _candidates(refinement):
        if not refinement.is_near_prior(start):
            continue
        hypothesis = refinement.from_start(start)
        best = hypothesis if best is None else better(best, hypothesis)
        enough = best.required_inlier_ratio(settings) + settings.search_margin
        if best.is_accepted(settings) and best.two_way_inlier_ratio > enough:
            break
    return refinement.from_start(np.eye(4)) if best is None else best


def _candidates(refinement: Refinement) -> Iterator[Matrix4]:
    """Yield identity and BEV candidates, the best after coarse alignment; then, more slowly, FPFH candidates."""
    source, target, settings = refinement.source, refinement.target, refinement.settings
    without_prior = refinement.prior is None
    starts = [np.eye(4)] if without_prior else []
    if settings.search_resolutions:
        count = _BEV_CANDIDATES if without_prior else 4 * _BEV_CANDIDATES
        starts += filter(refinement.is_near_prior, bev_candidates(source, target, count=count))
    for coarse in by_score(coarse_alignment(source, target, start) for start in starts)[:_BEST_CANDIDATES]:
        yield coarse.target_from_source
    seeds = settings.search_seeds if without_prior else 1
    for pose in fpfh_candidates(source, target, resolutions=settings.search_resolutions, seeds=seeds):
        coarse = coarse_alignment(source, target, pose)
        if coarse.score >= _WORTH:
            yield coarse.target_from_source


def best_quarter_turn(refinement: Refinement, best: Hypothesis) -> Hypothesis:
    """Return the best of a pose and its quarter turns: a rectangular room fits itself turned about its middle.

    Not asked where the pose is consistent with a prior, nor of a turn that does worse even in coarse alignment.
    """
    if best.consistent_with_prior:
        return best
    for start in quarter_turns(refinement.source, best.target_from_source):
        coarse = coarse_alignment(refinement.source, refinement.target, start)
        if coarse.score >= best.score:
            best = better(best, refinement.from_start(coarse.target_from_source))
    return best


def quarter_turns(source: Surface, pose: Matrix4) -> Iterator[Matrix4]:
    """Yield the pose turned by one, two and three quarters about the vertical through the middle of the source."""
    there = transformed(source.points, pose)
    center = (there.min(axis=0) + there.max(axis=0)) / 2
    for quarter in (1, 2, 3):
        turn = exponential(np.array([0.0, 0.0, quarter * np.pi / 2, 0.0, 0.0, 0.0]))
        turn[:3, 3] = center - turn[:3, :3] @ center
        yield turn @ pose


def registration_result(
    hypothesis: Hypothesis, origin: Floats | None, *, pose: Matrix4 | None = None
) -> RegistrationResult:
    """Return an accepted hypothesis as a result; `origin` (3,) is the sensor's place in the scan's frame, if known.

    `pose` is a better one that came of it, if there is one.
    """
    pose = hypothesis.target_from_source if pose is None else pose
    return RegistrationResult(
        map_from_scan=pose,
        sensor_origin=None if origin is None else transformed(origin[None], pose)[0],
        fitness=hypothesis.fitness,
        inlier_rmse=hypothesis.inlier_rmse,
        overlap=hypothesis.overlap,
        two_way_inlier_ratio=hypothesis.two_way_inlier_ratio,
        from_global_search=hypothesis.from_global_search,
        uncertainty=None,
    )
