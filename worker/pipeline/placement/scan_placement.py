"""Scan placement: where one scan was taken in a map, believed only where nothing contradicts it.

The best pose near the prior is looked for first. Where rays of both visits do not bear it out, the scan is looked for
in the whole map. Every pose found is held against the rays of both visits (`contradictions`), and the best one must
win against its rivals; a prior breaks ties, and never lowers the bar.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from worker.cloud.poses import difference, skew, transformed
from worker.cloud.types import Floats, Matrix4
from worker.pipeline.placement.belief import log_odds, odds_of
from worker.pipeline.placement.contradictions import (
    Place,
    contradictions,
    counted,
    held_both_ways,
)
from worker.pipeline.placement.placed_scan import NotPlaced, PlacedScan, other_place
from worker.pipeline.placement.scale import estimate_scale
from worker.pipeline.placement.settings import PlacementSettings
from worker.pipeline.placement.variants import up_axis
from worker.pipeline.registration.bev_correlation import bev_candidates
from worker.pipeline.registration.diagnosis import Diagnosis, length
from worker.pipeline.registration.fpfh_ransac import fpfh_candidates
from worker.pipeline.registration.hypothesis import Hypothesis
from worker.pipeline.registration.icp import icp, normal_equations
from worker.pipeline.registration.preprocessing import PreparedScan
from worker.pipeline.registration.refinement import CoarsePose, Refinement, by_score, coarse_alignment
from worker.pipeline.registration.results import ScanRejected
from worker.pipeline.registration.scan_to_map import quarter_turns, register
from worker.pipeline.registration.settings import RegistrationSettings
from worker.pipeline.registration.surface import Surface
from worker.pipeline.registration.verification import (
    rejected,
    require_accepted,
    require_constrained,
    require_unambiguous,
)

CLEAR = 0.9  #: confidence from which on nothing else is looked for
OVERCOMES = 0.99  #: confidence that a pose needs against a prior that says otherwise
OUTSIDE = 50.0  #: metres outside the map, from which on a prior is no start
_BEV_CANDIDATES, _NEAR_PRIOR = (
    12,
    48,
)  # that the bird's-eye views name: in the whole map, and to choose from near a prior
_BEST_CANDIDATES = 4  # of those that get a full ICP
_RIVAL = 0.93  # of the best coarse score, from which on another candidate is refined as well
_MIRRORED = 2  # candidates of the mirror image that get a full ICP
_HANDED = 1.1  # times the score of the scan that its mirror image has to have: a bare corridor is its own
_WORTH = 0.3  # coarse score of an FPFH candidate that gets a full ICP; right ones have 0.5 and more
_APART = (0.3, 0.17)  # metres, radians: poses nearer to each other are one
_SCALE_SIGMAS = 4.0  # that a scale has to be off to be told
_UP = 3  # the number of z among the axes
_WEAK = 1.8  # times the best held direction's error, from which on the pose may have slid along another
_FREE = 20.0  # likewise, from which on nothing there can tell one pose from another
_SLIDE = 0.2  # metres, that it is pushed to either side
_SLID = 0.04  # metres; what comes to rest nearer than this has come back
_SLIDE_DISTANCE, _SLIDE_ITERATIONS, _SLIDE_POINTS = 0.1, 15, 2500  # metres; of the ICP that tells


def place_scan(
    scan: PreparedScan,
    place: Place,
    *,
    prior: Matrix4 | None = None,
    registration: RegistrationSettings,
    placement: PlacementSettings,
    tick: Callable[[], None] = lambda: None,
) -> PlacedScan:
    """Find map_from_scan and believe it only where rays do not contradict it and no other pose does as well.

    Raises NotPlaced with a diagnosis. A prior that puts the scan well outside the map is no start: the scan is looked for
    without it, and where it has a place the prior is refused. Where neither the rays of the scan nor those of the map are known, surfaces
    decide alone, as in `registration.scan_to_map.register`.
    """
    astray = prior is not None and outside(scan, place, prior) > OUTSIDE
    search = _Search(
        scan=scan,
        place=place,
        prior=None if astray else prior,
        registration=registration,
        placement=placement,
        tick=tick,
    )
    try:
        blind = scan.sights is None and place.sights is None
        placed = search.by_surfaces() if blind else search.run()
        return replace(search, prior=prior).overcome(placed) if astray else placed
    except ScanRejected as error:
        raise NotPlaced(error, search.hypotheses()) from error


def outside(scan: PreparedScan, place: Place, map_from_scan: Matrix4) -> float:
    """Return how far outside the map (metres) a pose puts a scan; 0 where their boxes meet."""
    points, mapped = transformed(scan.surface.points, map_from_scan), place.surface.points
    gaps = np.maximum(mapped.min(axis=0) - points.max(axis=0), points.min(axis=0) - mapped.max(axis=0))
    return float(np.linalg.norm(np.maximum(gaps, 0.0)))


def poses_tried(
    scan: PreparedScan,
    place: Place,
    *,
    prior: Matrix4 | None = None,
    registration: RegistrationSettings,
    placement: PlacementSettings,
) -> tuple[PlacedScan, ...]:
    """Return every pose that `place_scan` holds against rays on its way: what a line of belief is fitted on."""
    search = _Search(
        scan=scan,
        place=place,
        prior=prior,
        registration=registration,
        placement=placement,
        tick=lambda: None,
    )
    with suppress(ScanRejected):
        search.run()
    return tuple(search.found)


def believed_by(place: Place) -> Callable[[PreparedScan, Hypothesis], bool]:
    """Return what tells whether rays bear a pose of a scan out; where none are known, surfaces have to do."""

    def believed(scan: PreparedScan, hypothesis: Hypothesis) -> bool:
        odds = log_odds(contradictions(scan, place, hypothesis.target_from_source))
        return odds is None or odds > 0

    return believed


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Search:
    scan: PreparedScan
    place: Place
    prior: Matrix4 | None
    registration: RegistrationSettings
    placement: PlacementSettings
    tick: Callable[[], None]
    found: list[PlacedScan] = field(default_factory=list)  #: every pose that was refined, without doubles

    def run(self) -> PlacedScan:
        """Search near the prior, then everywhere; decide; refine with all points."""
        if self.prior is not None:
            self._near_prior(self.prior)
        if not self._is_clear():
            self._everywhere()
        chosen = self._chosen()
        if self.prior is None and (self.scan.sights is None or self.place.sights is None):
            self._require_handed(chosen.hypothesis)
        source, target = self.scan.surface, self.place.surface
        require_constrained(self.scan.name, source, target, chosen.hypothesis, self.registration)
        around = replace(self._free.narrow(), prior=chosen.pose, tick=lambda: None)
        require_unambiguous(self.scan.name, chosen.hypothesis, around.from_start, self.registration)
        return self._settled(chosen)

    @property
    def _free(self) -> Refinement:
        """ICP that knows of no prior."""
        return Refinement(
            source=self.scan.surface,
            target=self.place.surface,
            prior=None,
            settings=self.registration,
            tick=self.tick,
        )

    def by_surfaces(self) -> PlacedScan:
        """Search as maps are built, where no rays are known; the mirror image has to fit worse."""
        hypothesis = register(
            self.scan, self.place.surface, prior=self.prior, settings=self.registration, tick=self.tick
        )
        if self.prior is None:
            self._require_handed(hypothesis)
        return self._measured(PlacedScan(hypothesis=hypothesis, told=None, log_odds=None))

    def _require_handed(self, hypothesis: Hypothesis) -> None:
        """Raise ScanRejected where the mirror image of the scan lies better on the map than the scan itself."""
        image = replace(self._free, source=self.scan.surface.reflected())
        starts = bev_candidates(image.source, image.target, count=_BEV_CANDIDATES)
        if not starts:  # no walls whose seen side is known
            resolutions = self.registration.search_resolutions
            starts = list(fpfh_candidates(image.source, image.target, resolutions=resolutions, seeds=1))
        coarse = by_score(coarse_alignment(image.source, image.target, start) for start in starts)
        found = [image.from_start(pose.target_from_source).score for pose in coarse[:_MIRRORED]]
        if max(found, default=0.0) > _HANDED * hypothesis.score:
            raise rejected(
                self.scan.name,
                hypothesis,
                "mirrored",
                f"its mirror image fits the map better (inlier ratio times overlap {max(found):.2f}) than it does "
                f"({hypothesis.score:.2f}); negate x or y, or read its axes as right-handed",
                mirrored=max(found),
                itself=hypothesis.score,
            )

    def hypotheses(self) -> list[Hypothesis]:
        """Return what was found, best first."""
        return [placed.hypothesis for placed in sorted(self.found, key=lambda placed: placed.rank)[::-1]]

    # --- finding poses

    def _near_prior(self, prior: Matrix4) -> None:
        refinement = replace(self._free, prior=prior)
        self._note(refinement.from_prior(prior))
        if not self._is_clear():
            starts = bev_candidates(self.scan.surface, self.place.surface, count=_NEAR_PRIOR)
            self._refine_best(filter(refinement.is_near_prior, starts))

    def _everywhere(self) -> None:
        """Try what the bird's-eye views name, quarter turns of the best, then local features."""
        starts = bev_candidates(self.scan.surface, self.place.surface, count=_BEV_CANDIDATES)
        self._refine_best([np.eye(4), *starts] if self.prior is None else starts)
        if self.found:
            best = max(self.found, key=lambda placed: placed.rank).pose
            (itself,) = self._coarse([best])
            self._refine_best(quarter_turns(self.scan.surface, best), least=_RIVAL * itself.score)
        if not self._is_clear():
            thoroughly = not any(map(self._is_accepted, self.found))
            self._refine_features(thoroughly=thoroughly, alone=not starts)

    def _refine_best(self, starts: Iterator[Matrix4] | list[Matrix4], *, least: float = 0.0) -> None:
        """Refine the best starts; once a pose is clear, only those that come near it in coarse alignment."""
        coarse = self._coarse(starts)[:_BEST_CANDIDATES]
        for candidate in coarse:
            enough = _RIVAL * coarse[0].score if self._is_clear() else 0.0
            if candidate.score >= max(enough, least) and not self._is_known(candidate.target_from_source):
                self._note(self._free.from_start(candidate.target_from_source))

    def _coarse(self, starts: Iterator[Matrix4] | list[Matrix4]) -> list[CoarsePose]:
        return by_score(coarse_alignment(self.scan.surface, self.place.surface, start) for start in starts)

    def _refine_features(self, *, thoroughly: bool, alone: bool) -> None:
        """Try what local features name: one draw, two where surfaces refuse all so far, all where nothing else does."""
        resolutions = self.registration.search_resolutions
        if not alone:
            resolutions = resolutions[: 2 if thoroughly else 1]
        seeds = self.registration.search_seeds if alone else 1
        for pose in fpfh_candidates(
            self.scan.surface, self.place.surface, resolutions=resolutions, seeds=seeds
        ):
            (coarse,) = self._coarse([pose])
            if coarse.score >= _WORTH and not self._is_known(coarse.target_from_source):
                self._note(self._free.from_start(coarse.target_from_source))
            if self._is_clear():
                return

    def _note(self, hypothesis: Hypothesis) -> None:
        placed = self._told(hypothesis)
        doubles = [other for other in self.found if _same(other.pose, placed.pose)]
        if all(placed.rank > other.rank for other in doubles):
            self.found[:] = [other for other in self.found if other not in doubles] + [placed]

    def _told(self, hypothesis: Hypothesis) -> PlacedScan:
        held = held_both_ways(self.scan, self.place, hypothesis.target_from_source)
        told = counted(held)
        return PlacedScan(hypothesis=hypothesis, told=told, log_odds=log_odds(told), held=held)

    # --- deciding between them

    def _chosen(self) -> PlacedScan:
        """Return the pose that wins against all others; the nearest to the prior of those that nothing tells apart."""
        accepted = sorted(filter(self._is_accepted, self.found), key=lambda placed: placed.rank)[::-1]
        if not accepted:
            raise self._refused()
        best = self._believed(accepted[0])
        least = (best.rank[0] if np.isfinite(best.rank[0]) else 0.0) - np.log(self.placement.min_rival_ratio)
        rivals = [placed for placed in accepted if placed.rank[0] >= least]
        if self.prior is not None:
            near = [placed for placed in rivals if self._is_near_prior(placed.pose)]
            if near:
                return self._believed(near[0])
        if len(rivals) > 1:
            raise self._ambiguous(rivals)
        return best if self.prior is None else self.overcome(best)

    def _is_accepted(self, placed: PlacedScan) -> bool:
        """Ask for what surfaces have to show; clear odds let a smaller overlap do, as a prior does."""
        found = placed.hypothesis
        if placed.log_odds is None:
            return found.is_accepted(self.registration)
        near = self.prior is not None and self._is_near_prior(placed.pose)
        vouched = near or self._odds_are_clear(placed)
        trusted = replace(found, consistent_with_prior=vouched, contradicts_prior=False)
        return trusted.is_accepted(self.registration)

    def _is_clear(self) -> bool:
        return any(self._odds_are_clear(placed) and self._is_accepted(placed) for placed in self.found)

    def _odds_are_clear(self, placed: PlacedScan) -> bool:
        return placed.log_odds is not None and placed.log_odds >= odds_of(CLEAR)

    def _is_known(self, pose: Matrix4) -> bool:
        """Tell whether a pose that fits was found there; where ICP got stuck, another start may do better."""
        return any(_same(placed.pose, pose) for placed in self.found if self._is_accepted(placed))

    def _is_near_prior(self, pose: Matrix4) -> bool:
        return replace(self._free, prior=self.prior).is_near_prior(pose)

    def _believed(self, placed: PlacedScan) -> PlacedScan:
        """Raise ScanRejected where rays contradict the pose."""
        if placed.confidence is not None and placed.confidence < self.placement.min_scan_confidence:
            raise other_place(self.scan.name, placed)
        return placed

    def overcome(self, placed: PlacedScan) -> PlacedScan:
        """Say by how much the prior was wrong; raise ScanRejected where that is too much, or the pose is not clear."""
        if self.prior is None:
            raise ValueError("a scan without a prior has none that is wrong")
        metres, radians = difference(placed.pose, self.prior)
        numbers = {"metres": metres, "degrees": float(np.degrees(radians))}
        off = f"{length(metres)} and {numbers['degrees']:.0f} degrees"
        sure = placed.log_odds is not None and placed.log_odds >= odds_of(OVERCOMES)
        if metres > self.placement.max_prior_distance or not sure:
            raise rejected(
                self.scan.name,
                placed.hypothesis,
                "wrong_prior",
                f"it fits the map {off} from its prior and not near it; check the prior, or leave it out",
                **numbers,
                outside=outside(self.scan, self.place, self.prior),
                **({} if placed.confidence is None else {"confidence": placed.confidence}),
            )
        detail = f"scan {self.scan.name}: its prior is off by {off}; the place was found without it"
        warning = Diagnosis(reason="wrong_prior", detail=detail, numbers=numbers)
        return replace(placed, warnings=(*placed.warnings, warning))

    # --- refusing

    def _refused(self) -> ScanRejected:
        """Return the error of a scan without an accepted pose: of the best one, near the prior if there is one there."""
        near = [
            placed for placed in self.found if self.prior is not None and self._is_near_prior(placed.pose)
        ]
        best = max(near or self.found, key=lambda placed: placed.hypothesis.score)
        hypothesis = replace(best.hypothesis, consistent_with_prior=bool(near))
        try:
            require_accepted(self.scan.name, hypothesis, self.registration)
        except ScanRejected as error:
            return error
        return other_place(self.scan.name, best)

    def _ambiguous(self, rivals: list[PlacedScan]) -> ScanRejected:
        best, other = rivals[:2]
        metres, radians = difference(best.pose, other.pose)
        error = rejected(
            self.scan.name,
            best.hypothesis,
            "ambiguous",
            f"it fits at {len(rivals)} places alike, {metres:.1f} m and {np.degrees(radians):.0f} degrees apart; "
            "give a pose prior, or scan more of the place",
            metres=metres,
            degrees=float(np.degrees(radians)),
            poses=len(rivals),
        )
        poses = tuple(placed.pose for placed in rivals)
        return ScanRejected(
            replace(error.diagnosis, poses=poses), fitness=error.fitness, inlier_rmse=error.inlier_rmse
        )

    # --- the last steps

    def _settled(self, placed: PlacedScan) -> PlacedScan:
        """Refine with every point; along a direction that is held weakly, look for a better pose to either side."""
        settled = self._final(placed)
        weak = _weak_direction(self.scan.surface, self.place.surface, settled.pose)
        for shift in () if weak is None else (weak * _SLIDE, -weak * _SLIDE):
            slid = self._slid(settled.pose, shift)
            if difference(slid, settled.pose)[0] < _SLID:
                continue
            other = self._final(self._told(self._free.narrow().from_start(slid)))
            if other.rank > settled.rank and other.hypothesis.score > settled.hypothesis.score:
                settled = other
        return self._measured(replace(settled, warnings=placed.warnings))

    def _slid(self, pose: Matrix4, shift: Floats) -> Matrix4:
        """Return where a few points end that start beside a pose: mostly where they came from."""
        start = pose.copy()
        start[:3, 3] += shift
        return icp(
            self.scan.surface,
            self.place.surface,
            start,
            max_correspondence_distance=_SLIDE_DISTANCE,
            max_iterations=_SLIDE_ITERATIONS,
            robust=True,
            every=max(1, len(self.scan.surface.points) // _SLIDE_POINTS),
            tick=self.tick,
        ).target_from_source

    def _measured(self, placed: PlacedScan) -> PlacedScan:
        """Tell of a scale that is off; raise ScanRejected where it is off by too much."""
        placed = self._upright(placed)
        estimate = estimate_scale(self.scan.surface, self.place.surface, placed.pose, self.scan.origin)
        if not estimate.is_off_by(self.placement.max_scale_error, sigmas=_SCALE_SIGMAS):
            return placed
        scale, numbers = estimate.scale, {"scale": estimate.scale, "sigma": estimate.sigma}
        detail = (
            f"it fits the map better after its lengths are multiplied by {scale:.4f} (sigma {estimate.sigma:.4f}); "
            "check the sensor's calibration"
        )
        too_far = estimate.is_off_by(self.placement.refused_scale_error, sigmas=_SCALE_SIGMAS)
        if self.placement.scale == "refuse" or too_far:
            raise rejected(self.scan.name, placed.hypothesis, "wrong_scale", detail, **numbers)
        warning = Diagnosis(reason="wrong_scale", detail=f"scan {self.scan.name}: {detail}", numbers=numbers)
        return replace(placed, warnings=(*placed.warnings, warning))

    def _upright(self, placed: PlacedScan) -> PlacedScan:
        """Tell of a scan that lies on the map with another axis up than z."""
        return replace(placed, warnings=(*placed.warnings, *turned_up(self.scan.name, placed.pose)))

    def _final(self, placed: PlacedScan) -> PlacedScan:
        return self._told(self._free.final(placed.hypothesis))


def turned_up(name: str, map_from_scan: Matrix4) -> tuple[Diagnosis, ...]:
    """Return the warning of a scan that lies on the map with another axis up than z; none where z is up."""
    number = up_axis(map_from_scan[:3, :3])
    if number == _UP:
        return ()
    axis = ("-" if number < 0 else "") + "xyz"[abs(number) - 1]
    detail = f"scan {name}: its {axis} axis points up, not z; it was turned to fit the map"
    return (Diagnosis(reason="other_up_axis", detail=detail, numbers={"up": number}),)


def _same(a: Matrix4, b: Matrix4) -> bool:
    metres, radians = difference(a, b)
    return metres < _APART[0] and radians < _APART[1]


def _weak_direction(source: Surface, target: Surface, pose: Matrix4) -> Floats | None:
    """Return the unit vector (3,) along which the sensor's place is held worst; None where as well, or not at all.

    A corridor holds a scan along itself by what stands there alone; ICP may stop a decimetre off.
    """
    equations = normal_equations(source, target, pose, max_correspondence_distance=0.05, every=4)
    information = equations.information + 1e-6 * np.trace(equations.information) * np.eye(6)
    arm = np.hstack([-skew(pose[:3, 3]), np.eye(3)])
    variances, directions = np.linalg.eigh(arm @ np.linalg.inv(information) @ arm.T)
    weakness = np.sqrt(variances[-1] / variances[0])
    return directions[:, -1] if _WEAK < weakness < _FREE else None
