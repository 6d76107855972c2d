"""Registration: where in the map a scan was taken (paper, Section 3.3.2 and Table 1)."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from worker.cloud.poses import difference, transformed
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.registration.degeneracy import least_eigenvalue
from worker.pipeline.registration.hypothesis import (
    Hypothesis,
    better,
    is_accepted,
    needed_agreement,
    refined,
    searched,
    turned,
)
from worker.pipeline.registration.icp import Surface, icp
from worker.pipeline.registration.preprocessing import PreparedScan, ScanRejected
from worker.pipeline.registration.results import RegistrationResult
from worker.pipeline.registration.settings import RegistrationSettings

_NUDGES = ((0.15, 0.0), (-0.15, 0.0), (0.0, 0.15), (0.0, -0.15))  # metres, x and y
_POLISHING = 20  # iterations of ICP with all points, at most
_AS_GOOD = 0.9  # of the best pose's score


def register(
    scan: PreparedScan,
    target: Surface,
    *,
    start: Matrix4 | None = None,
    settings: RegistrationSettings,
    tick: Callable[[], None] = lambda: None,
) -> Hypothesis:
    """Find target_from_source by ICP from `start` (a prior of it; identity if None), else by global search.

    Table 1 alone accepts wrong poses (a room laid over the next one reaches fitness 0.60) and refuses true ones
    of sparse scans (0.48). So both clouds must lie on common surfaces, seen from either side, over half of the
    scan or with Table 1's fitness. A pose near a given prior needs less of it; one far from it is not taken,
    because buildings repeat themselves. See docs/decisions.

    Raises ScanRejected with the best numbers reached, or where what is shared cannot hold a pose.
    """
    source = scan.surface
    refine = functools.partial(refined, source, target, start, settings=settings, tick=tick)
    best = None if start is None else refine(None)
    if best is not None and not is_accepted(best, settings):
        # where little is shared the wide gates may drag a good prior away
        narrow = settings.model_copy(update={"coarse_distances": settings.coarse_distances[-1:]})
        best = better(best, refine(None, settings=narrow))
    if best is None or not is_accepted(best, settings):
        best = searched(source, target, best, start, refine, settings)
    if is_accepted(best, settings):
        best = turned(source, target, best, refine)
    else:
        raise _rejected(scan.name, best, _why_not(best, settings))
    _require_held(scan.name, source, target, best, settings)
    _require_steady(scan.name, source, target, best, settings)
    return _polished(source, target, best, settings, tick)


def _rejected(name: str, best: Hypothesis, reason: str) -> ScanRejected:
    rmse = best.found.inlier_rmse
    return ScanRejected(
        f"scan {name}: {reason}",
        fitness=best.found.fitness,
        inlier_rmse=rmse if np.isfinite(rmse) else None,
    )


def _why_not(best: Hypothesis, settings: RegistrationSettings) -> str:
    return (
        f"fitness {best.found.fitness:.2f} (over {settings.min_fitness:g} is accepted), "
        f"inlier RMSE {best.found.inlier_rmse * 100:.1f} cm, agreement {best.seen.mutual:.2f} "
        f"(at least {needed_agreement(best, settings):g}) over {best.seen.overlap:.0%} of the scan; "
        + _advice(best)
    )


def _advice(best: Hypothesis) -> str:
    if best.contradicts_prior:
        return "it ends far from the pose prior that was given; check the prior, or leave it out"
    if best.consistent_with_prior:
        return "check the pose prior that was given, and that the place is in the map"
    return "give an initial pose, or check that the place is in the map"


def _require_held(
    name: str, source: Surface, target: Surface, best: Hypothesis, settings: RegistrationSettings
) -> None:
    """A scan may be rich and yet share only a plane with the map."""
    there = transformed(source.points, best.found.target_from_source)
    distance, _ = target.nearest(there, within=settings.max_correspondence_distance)
    held = least_eigenvalue(source.points[np.isfinite(distance)])
    if held < settings.min_eigenvalue:
        reason = (
            f"what it shares with the map leaves a motion free (constraint {held:.4f}, at least "
            f"{settings.min_eigenvalue:g} is needed); scan more of the mapped place"
        )
        raise _rejected(name, best, reason)


def _polished(
    source: Surface,
    target: Surface,
    best: Hypothesis,
    settings: RegistrationSettings,
    tick: Callable[[], None],
) -> Hypothesis:
    """The pose after a few more steps with every point: candidates were told apart by some of them.

    Sparse clouds gain by it; `ipad_rooms` 808 comes from 1.7 cm off to 0.6.
    """
    found = icp(
        source,
        target,
        best.found.target_from_source,
        max_correspondence_distance=settings.max_correspondence_distance,
        max_iterations=min(_POLISHING, settings.max_iterations),
        tick=tick,
    )
    return replace(best, found=found)


def _require_steady(
    name: str, source: Surface, target: Surface, best: Hypothesis, settings: RegistrationSettings
) -> None:
    """Where little is shared, a scan may fit as well a decimetre away: then nothing says which place is its own.

    A simulated scan that saw the map through a door fitted anywhere along 23 cm, agreement 0.85 to 0.86 throughout.
    """
    if best.seen.overlap >= settings.min_overlap:
        return
    narrow = settings.model_copy(update={"coarse_distances": settings.coarse_distances[-1:]})
    pose = best.found.target_from_source
    for shift in _NUDGES:
        nudged = pose.copy()
        nudged[:2, 3] += shift
        rival = refined(source, target, pose, nudged, settings=narrow, tick=lambda: None)
        apart, _ = difference(rival.found.target_from_source, pose)
        as_good = rival.seen.score >= _AS_GOOD * best.seen.score and is_accepted(rival, settings)
        if as_good and apart > settings.max_ambiguity_distance:
            reason = (
                f"it fits as well {apart * 100:.0f} cm away (agreement {rival.seen.mutual:.2f} there, "
                f"{best.seen.mutual:.2f} here, over {best.seen.overlap:.0%} of the scan); scan more of the mapped place"
            )
            raise _rejected(name, best, reason)


def placement_of(
    best: Hypothesis, origin: Floats | None, *, pose: Matrix4 | None = None
) -> RegistrationResult:
    """A believed pose as a placement; `origin` (3,) is the sensor's place in the scan's frame, where it is known.

    `pose` is a better one that came of it, if there is one.
    """
    pose = best.found.target_from_source if pose is None else pose
    return RegistrationResult(
        map_from_scan=pose,
        sensor_origin=None if origin is None else transformed(origin[None], pose)[0],
        fitness=best.found.fitness,
        inlier_rmse=best.found.inlier_rmse,
        overlap=best.seen.overlap,
        agreement=best.seen.mutual,
        searched=best.searched,
        uncertainty=None,
    )
