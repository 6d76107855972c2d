"""Explanations: why a scan that was refused does not lie on the map, found by trying what would make it lie there.

Each explanation is a variant of the scan (scaled, mirrored, turned, its first and last points apart) that has to be
accepted *and* believed as any scan is. The cheap ones are tried first. It costs up to some ten registrations, and is
asked of refused scans alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.cloud.formats.scan import Scan
from worker.cloud.poses import difference, transformed
from worker.cloud.types import Floats, Matrix4, Points
from worker.errors import MapFailed
from worker.pipeline.placement.damage import damage_of
from worker.pipeline.placement.scale import estimate_scale
from worker.pipeline.placement.variants import UP_AXES, mirrored, part, scaled, turned, up_axis
from worker.pipeline.registration.bev_correlation import bev_candidates
from worker.pipeline.registration.diagnosis import Diagnosis, Reason
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.refinement import Refinement, by_score, coarse_alignment
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.scan_to_map import global_registration
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import inlier_share

#: What lengths in other units are to be multiplied by to be metres, and the reverse of each.
UNITS: dict[str, float] = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048}
FACTORS = tuple(factor for unit in UNITS.values() for factor in (unit, 1 / unit))
_SAME_HEIGHT = 1.25  # times: two heights from floor to ceiling that may be one
_WORTH_SCALING = 1.05  # times the map's height, from which on the height itself is tried as the scale
_BETTER = 1.0  # of the best score of the scan as it is, that a variant has to reach in coarse alignment
_CANDIDATES, _REFINED = 12, 2  # of a search: that the bird's-eye views name, and that get a full ICP
_STRAYS = (1, 99)  # percentiles, between which a cloud's height is measured
#: share of a scan near the map at a pose, from which on a scale or a motion may be all that keeps it from lying there
_COVERED = (0.3, 0.5)
_TRIED = 2  # hypotheses whose scale is estimated
_LEAST_OFF = 0.006  # scales nearer to 1 explain no refusal: right scans were estimated up to 0.5% off
_MOVED = (
    0.05,
    float(np.radians(1.0)),
)  # metres, radians between the places of the first and of the last points
_GAIN = (
    0.05  # share of those points that lie on the map at a pose of their own, and not at that of the others
)
_ON_SURFACE = 0.03  # metres
_ENDS = ((0.0, 0.2), (0.8, 1.0))  # of the file

Prepare = Callable[[Scan], PreparedScan]
Believed = Callable[[PreparedScan, Hypothesis], bool]


@dataclass(frozen=True, kw_only=True, slots=True)
class Refused:
    """A scan that was refused, and what is needed to find out why."""

    scan: Scan  #: its points in the file's order
    prepared: PreparedScan | None  #: None where it could not even be prepared
    hypotheses: Sequence[Hypothesis]  #: target_from_source each, best first: what was reached; may be empty
    target: Surface  #: the map
    settings: RegistrationSettings
    prepare: Prepare  #: as every scan is prepared; may raise ScanRejected
    believed: Believed  #: whether what both visits saw bears a pose out
    max_searches: int = 6  #: global registrations that may be spent
    #: called before every iteration of ICP; may raise to stop the work
    tick: Callable[[], None] = lambda: None

    def diagnosis(self, reason: Reason, detail: str, **numbers: float) -> Diagnosis:
        """Return a diagnosis that names the scan."""
        return Diagnosis(reason=reason, detail=f"scan {self.scan.name}: {detail}", numbers=numbers)

    def refinement(self, source: Surface) -> Refinement:
        """Return ICP to the map without a prior, whose search draws once."""
        brief = self.settings.with_values(
            search_resolutions=self.settings.search_resolutions[:1], search_seeds=1
        )
        return Refinement(source=source, target=self.target, prior=None, settings=brief, tick=self.tick)

    def search(self, prepared: PreparedScan) -> Iterator[Hypothesis]:
        """Yield hypotheses of a variant anywhere on the map, of the likeliest start first.

        Variants are upright, so that the bird's-eye views do where they can be drawn; else the whole search. The best
        by score is not always the true one, as rooms of one building are alike: that is left to `holds`.
        """
        refinement = self.refinement(prepared.surface)
        starts = bev_candidates(prepared.surface, self.target, count=_CANDIDATES)
        coarse = by_score(coarse_alignment(prepared.surface, self.target, start) for start in starts)
        least = _BETTER * max((hypothesis.score for hypothesis in self.hypotheses), default=0.0)
        for pose in coarse[:_REFINED]:
            if pose.score >= least:
                yield refinement.from_start(pose.target_from_source)
        if not starts:
            yield global_registration(refinement, None)

    def ready(self, variant: Scan) -> PreparedScan | None:
        """Prepare a variant; None where it cannot be registered to anything."""
        try:
            return self.prepare(variant)
        except (ScanRejected, MapFailed):
            return None

    def holds(self, prepared: PreparedScan | None, hypothesis: Hypothesis) -> bool:
        """Tell whether a hypothesis is accepted, and believed."""
        if prepared is None or not hypothesis.is_accepted(self.settings):
            return False
        return self.believed(prepared, hypothesis)


def diagnose(case: Refused) -> Diagnosis | None:
    """Return the first explanation that holds; None where none does, as of a scan of another place."""
    for explain in (_scale_as_it_lies, _motion, _damage, _after_a_search, _little_overlap):
        diagnosis = explain(case)
        if diagnosis is not None:
            return diagnosis
    return None


def _scale_as_it_lies(case: Refused) -> Diagnosis | None:
    """Estimate the scale at the best hypotheses; scale the scan and refine where it surely is off."""
    for hypothesis in case.hypotheses[:_TRIED]:
        diagnosis = _scaled_from(case, case.prepared, 1.0, hypothesis)
        if diagnosis is not None:
            return diagnosis
    return None


def _scaled_from(
    case: Refused, prepared: PreparedScan | None, factor: float, hypothesis: Hypothesis
) -> Diagnosis | None:
    """Estimate the scale of a scan multiplied by `factor`, at a pose of it; a diagnosis if it then holds."""
    if prepared is None or hypothesis.overlap < _COVERED[0]:
        return None
    estimate = estimate_scale(prepared.surface, case.target, hypothesis.target_from_source, prepared.origin)
    scale = factor * estimate.scale
    if factor == 1.0 and not estimate.is_off_by(_LEAST_OFF):
        return None
    variant = case.ready(scaled(case.scan, scale))
    if variant is None:
        return None
    refined = case.refinement(variant.surface).from_start(estimate.target_from_source)
    if not case.holds(variant, refined):
        return None
    return case.diagnosis(
        "wrong_scale",
        f"it fits the map after its lengths are multiplied by {scale:.4g} ({_unit(scale)}sigma "
        f"{estimate.sigma:.1%}; inlier ratio {refined.two_way_inlier_ratio:.2f} over {refined.overlap:.0%} "
        "of the scan then); check its units and the sensor's calibration",
        scale=scale,
        sigma=scale * estimate.sigma,
    )


def _unit(scale: float) -> str:
    names = [name for name, factor in UNITS.items() if abs(np.log(scale / factor)) < 0.03]
    return f"as if it were in {names[0]}; " if names else ""


def _motion(case: Refused) -> Diagnosis | None:
    """Align the first and the last fifth of the points by themselves: do they lie on the map, but apart?"""
    starts = [hypothesis for hypothesis in case.hypotheses[:1] if hypothesis.overlap >= _COVERED[1]]
    ends = [case.ready(part(case.scan, *shares)) for shares in _ENDS] if starts else []
    ready = [end for end in ends if end is not None]
    for start in starts if len(ready) == len(_ENDS) else ():
        own = [case.refinement(end.surface).from_start(start.target_from_source) for end in ready]
        poses = [hypothesis.target_from_source for hypothesis in own]
        metres, radians = _apart(case.scan.points, *poses)
        if metres <= _MOVED[0] and radians <= _MOVED[1]:
            continue
        gains = [
            _on_map(case, end, pose) - _on_map(case, end, other)
            for end, pose, other in zip(ready, poses, poses[::-1], strict=True)
        ]
        if min(gains) >= _GAIN and all(map(case.holds, ready, own)):
            degrees = float(np.degrees(radians))
            return case.diagnosis(
                "moved_while_scanning",
                f"its first and last fifth fit the map {metres * 100:.0f} cm and {degrees:.1f} degrees apart: the "
                "sensor moved; scan again and stand still",
                metres=metres,
                degrees=degrees,
            )
    return None


def _apart(points: Points, one: Matrix4, other: Matrix4) -> tuple[float, float]:
    """Return by how many metres, in the middle of the points (N, 3), and by how many radians two poses differ."""
    middle = points.mean(axis=0, dtype=np.float64)[None]
    metres = float(np.linalg.norm(transformed(middle, one) - transformed(middle, other)))
    return metres, difference(one, other)[1]


def _on_map(case: Refused, prepared: PreparedScan, pose: Matrix4) -> float:
    overlap, on_surface = inlier_share(prepared.surface, case.target, pose, surface_distance=_ON_SURFACE)
    return overlap * on_surface


def _damage(case: Refused) -> Diagnosis | None:
    """Look at the points alone; not first, for a scan that a motion blurred lies on no surfaces either."""
    damage = damage_of(case.scan.points)
    if damage is None:
        return None
    return case.diagnosis("damaged", f"{damage.detail}; export it again", **damage.numbers)


def _after_a_search(case: Refused) -> Diagnosis | None:
    """Look for variants of the scan anywhere on the map, as many as may be."""
    for attempt in islice(_attempts(case), case.max_searches):
        diagnosis = attempt()
        if diagnosis is not None:
            return diagnosis
    return None


def _attempts(case: Refused) -> Iterator[Callable[[], Diagnosis | None]]:
    """Yield what costs a global registration each: other scales by the height, the mirror image, other axes up."""
    heights, height = [_height(axis) for axis in case.scan.points.T], _height(case.target.points[:, 2])
    for factor in _factors(height / max(heights[2], 1e-9)):
        yield functools.partial(_scaled_anywhere, case, factor)
    yield functools.partial(_mirror_image, case)
    for axis, turn in UP_AXES.items():
        if abs(np.log(max(heights[abs(axis) - 1], 1e-9) / height)) <= np.log(_SAME_HEIGHT):
            yield functools.partial(_turned_up, case, turn)


def _height(along: NDArray[Any]) -> float:
    """Return the extent (metres) of coordinates (N,), less strays: from floor to ceiling where z is up."""
    low, high = np.percentile(along, _STRAYS)
    return float(high - low)


def _factors(ratio: float) -> tuple[float, ...]:
    """Return the scales that bring a scan to the map's height, which is `ratio` times its own; units first."""
    if 1 / _WORTH_SCALING <= ratio <= _WORTH_SCALING:
        return ()
    units = [factor for factor in FACTORS if abs(np.log(ratio / factor)) < np.log(_SAME_HEIGHT)]
    return (*units, ratio)


def _scaled_anywhere(case: Refused, factor: float) -> Diagnosis | None:
    """Search the map for the scan multiplied by `factor`, then estimate its scale where it lies best."""
    prepared = case.ready(scaled(case.scan, factor))
    if prepared is None:
        return None
    tried = (_scaled_from(case, prepared, factor, hypothesis) for hypothesis in case.search(prepared))
    return next((diagnosis for diagnosis in tried if diagnosis is not None), None)


def _mirror_image(case: Refused) -> Diagnosis | None:
    prepared = case.ready(mirrored(case.scan))
    if prepared is None or not any(case.holds(prepared, hypothesis) for hypothesis in case.search(prepared)):
        return None
    detail = "its mirror image fits the map, it does not; negate x or y, or read its axes as right-handed"
    return case.diagnosis("mirrored", detail)


def _turned_up(case: Refused, turn: Floats) -> Diagnosis | None:
    """Search the map for the scan with another axis up; the pose that holds says which axis of the file it is."""
    prepared = case.ready(turned(case.scan, turn))
    if prepared is None:
        return None
    held = (hypothesis for hypothesis in case.search(prepared) if case.holds(prepared, hypothesis))
    hypothesis = next(held, None)
    if hypothesis is None:
        return None
    number = up_axis(hypothesis.target_from_source[:3, :3] @ turn)
    name = ("-" if number < 0 else "") + "xyz"[abs(number) - 1]
    detail = f"it fits the map where its {name} axis points up; turn it so that z does"
    return case.diagnosis("other_up_axis", detail, up=number)


def _little_overlap(case: Refused) -> Diagnosis | None:
    """Ask whether the best hypothesis lacks nothing but more of the scan in the map."""
    if not case.hypotheses or case.prepared is None:
        return None
    best, settings = case.hypotheses[0], case.settings
    fits = best.two_way_inlier_ratio >= best.required_inlier_ratio(settings)
    close = best.inlier_rmse < settings.max_inlier_rmse and not best.contradicts_prior
    if not (fits and close) or best.overlap >= settings.min_overlap or not case.believed(case.prepared, best):
        return None
    return case.diagnosis(
        "too_little_overlap",
        f"the map covers {best.overlap:.0%} of it, {settings.min_overlap:.0%} is needed; what is shared fits (inlier "
        f"ratio {best.two_way_inlier_ratio:.2f}); scan more of the mapped place, or let the map grow",
        overlap=best.overlap,
    )
