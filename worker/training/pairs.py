"""Training pairs from tiles without any label (paper, Section 3.5.3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from worker.cloud.patches import patch
from worker.cloud.types import Points
from worker.detectors.trainable import CHANGED, DIFFERENT, UNCHANGED, Pair
from worker.training.anomalies import OPERATIONS, ChangeSize, Half, Operation, shown
from worker.training.augmentation import Augmentation, Nuisance, augmented, second_observation, turned_alike
from worker.training.dataset import Observation, TileSet

SAMPLE_POINTS = 128  #: of the Chamfer branch in the paper (Section 3.6.3)
STORED_JITTER = 0.0001  #: metres, where the stored reference patch itself comes back


@dataclass(frozen=True, kw_only=True, slots=True)
class PairSettings:
    """How pairs are made; the defaults are the paper's but for those that say so."""

    patch_points: int = 4096  #: points of a padded patch
    #: Ours: the Chamfer branch compares all points of both patches; the paper's is 128 of each.
    chamfer_points: int | None = None
    counts: bool = False  #: ours: the head is given point counts beside the Chamfer statistics
    shares: tuple[float, float, float] = (0.50, 0.35, 0.15)  #: of the three classes
    #: Of unchanged pairs of one observation: sampled anew, the rest are stored patches.
    rerun_share: float = 0.7
    #: Ours: a stored patch that comes back is not augmented either, nor a change of one.
    stored_still: bool = True
    #: Ours: of such pairs and of rebuilt maps, how many come with noise of one level on every current point, and up
    #: to which level in metres. A head that only ever saw still pairs takes noise for another visit, and misses all.
    noisy_share: float = 0.0
    noise: float = 0.015
    #: Ours: half of those also lose points, up to this share. By point counts alone, fewer points are a removal.
    thinning: float = 0.35
    #: Ours: of changed pairs, those of whole things added, removed or moved, where there are any.
    edited_share: float = 0.65
    #: Ours: of changed pairs, those changed in some of the scans that the map is fused of.
    rebuilt_share: float = 0.35
    #: Ours: of unchanged pairs that match no changed one, those beside a change, where there are any.
    beside_share: float = 0.5
    revisit_share: float = 0.7  #: ours: pairs of both visits, where there are two; 0 is the paper's protocol
    revisit_intensity: float = 0.0  #: ours: of the nuisance on such pairs, which have an honest one
    changed_intensity: float = 0.5  #: of the nuisance on changed pairs
    magnitude: tuple[float, float] = (0.10, 0.50)  #: metres
    density: tuple[float, float] = (0.075, 0.075)  #: share of the tile's points; the paper fixes 7.5%
    min_shown: int = 40  #: ours: points of a change that must lie `shown_distance` off; 0 is the paper's
    shown_distance: float = 0.075  #: metres; with `min_shown` what the simulator's truth calls a change
    min_separation: float = 3.0  #: metres between different tiles of one building
    symmetries: bool = True  #: ours: both patches under one of the square's eight symmetries
    #: Ours: a changed pair comes with an unchanged one of the same tile and observations.
    matched_pairs: bool = True
    augmentation: Augmentation = field(default_factory=Augmentation)
    nuisance: Nuisance = field(default_factory=Nuisance)


#: Section 3.5 to the letter; docs/decisions/0006 says why it is not the default.
PAPER_PAIRS = PairSettings(
    chamfer_points=SAMPLE_POINTS,
    stored_still=False,
    edited_share=0.0,
    rebuilt_share=0.0,
    beside_share=0.0,
    revisit_share=0.0,
    min_shown=0,
    symmetries=False,
    matched_pairs=False,
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Disturbance:
    """What a whole tile suffers beside any change: of one level everywhere, unlike what another visit brings."""

    noise: float  #: metres, sigma on every point
    lost: float  #: share of the points


@dataclass(frozen=True, kw_only=True, slots=True)
class Observations:
    """Two dense observations of one tile, (n, 3) each, with nothing changed in between, and two with a change."""

    unchanged: tuple[Points, Points]
    changed: tuple[Points, Points] | None = None  #: None: a synthetic change is due
    revisit: bool = False  #: of two visits, not one tile twice
    #: Of the very same scans, so that nothing differs but the change: no nuisance, no augmentation.
    still: bool = False
    disturbance: Disturbance | None = None  #: of the current side: one for a changed pair and what matches it


class PairMaker:
    """Draws pairs from a set of tiles; the same generator gives the same pairs."""

    def __init__(self, tiles: TileSet, settings: PairSettings) -> None:
        if len(tiles) < 2:
            raise ValueError(f"pairs need at least two tiles, there are {len(tiles)}")
        self._tiles = tiles
        self._settings = settings
        self._edited, self._rebuilt, self._beside, self._untouched = (
            [
                observation
                for observation in tiles.observations
                if (observation.changed, observation.rebuilt) == kind
            ]
            for kind in ((True, False), (True, True), (False, False), (False, True))
        )

    def batches(self, count: int, size: int, rng: np.random.Generator) -> Iterator[list[Pair]]:
        """Draw `count` pairs in the classes' exact shares, `size` at a time; a last few are left out.

        With `matched_pairs` each changed pair comes with an unchanged one of the same tile and observations, so that
        nothing but the change tells them apart.
        """
        ready: list[Pair] = []
        groups = composition(count, self._settings.shares, matched_pairs=self._settings.matched_pairs)
        for place in rng.permutation(len(groups)):
            observations = self._observations(groups[place], rng)
            ready += [self.pair(label, rng, observations) for label in groups[place]]
            if len(ready) >= size:
                yield ready[:size]
                ready = ready[size:]

    def pair(self, label: int, rng: np.random.Generator, observations: Observations | None = None) -> Pair:
        """Draw one example of a class, of the given observations where the class is of one tile."""
        observations = observations or self._observations((label,), rng)
        settings = self._settings
        if label == DIFFERENT:
            reference, current = self._different(rng)
        elif label == CHANGED:
            reference, current = self._changed(observations, rng)
        else:
            reference, current = self._unchanged(observations, rng)
        if settings.symmetries:
            reference, current = turned_alike(reference, current, rng)
        if label == DIFFERENT or not (observations.still and settings.stored_still):
            reference = augmented(reference, settings.augmentation, rng)
            current = augmented(current, settings.augmentation, rng)
        return Pair(reference, disturbed(current, observations.disturbance, rng), label)

    def _unchanged(self, observations: Observations, rng: np.random.Generator) -> tuple[Points, Points]:
        if observations.still and self._settings.stored_still:
            return self._sampled(*observations.unchanged, 0.0, rng)
        if observations.still:
            stored = self._patch(observations.unchanged[0], rng)
            return stored, _stored_again(stored, rng)
        intensity = self._settings.revisit_intensity if observations.revisit else 1.0
        return self._sampled(*observations.unchanged, intensity, rng)

    def _changed(self, observations: Observations, rng: np.random.Generator) -> tuple[Points, Points]:
        settings = self._settings
        intensity = settings.revisit_intensity if observations.revisit else settings.changed_intensity
        if observations.still and settings.stored_still:
            intensity = 0.0
        if observations.changed is not None:
            return self._sampled(*observations.changed, intensity, rng)
        first, second = observations.unchanged
        return self._sampled(first, changed(second, settings, self._tiles.half, rng), intensity, rng)

    def _different(self, rng: np.random.Generator) -> tuple[Points, Points]:
        """Draw tiles of two buildings, or `min_separation` apart in one. Raises ValueError where no two are."""
        points = self._tiles.points_a
        i = int(rng.integers(len(points)))
        others = self._apart(i)
        if len(others) == 0:  # in the middle of a small place; others of its tiles may be apart
            usable = [other for other in range(len(points)) if len(self._apart(other))]
            if not usable:
                raise ValueError(f"no two tiles are {self._settings.min_separation} m apart")
            i = int(rng.choice(usable))
            others = self._apart(i)
        return self._patch(points[i], rng), self._patch(points[int(rng.choice(others))], rng)

    def _apart(self, i: int) -> NDArray[np.intp]:
        """Return the tiles that are no part of tile i's surroundings."""
        tiles = self._tiles
        away = np.linalg.norm(tiles.centres - tiles.centres[i], axis=1) >= self._settings.min_separation
        return np.flatnonzero(away | (tiles.buildings != tiles.buildings[i]))

    def _observations(self, labels: tuple[int, ...], rng: np.random.Generator) -> Observations:
        """Draw a tile for pairs of these labels; visits in either order."""
        settings, draw = self._settings, rng.random()
        if CHANGED in labels:
            if draw < settings.edited_share and self._edited:
                return self._revisited(self._edited[int(rng.integers(len(self._edited)))], rng)
            if (
                settings.edited_share <= draw < settings.edited_share + settings.rebuilt_share
                and self._rebuilt
            ):
                return self._rebuilt_observations(rng)
        elif UNCHANGED in labels and draw < settings.beside_share and self._beside:
            return self._revisited(self._beside[int(rng.integers(len(self._beside)))], rng)
        return self._two_observations(rng)

    def _two_observations(self, rng: np.random.Generator) -> Observations:
        tiles, settings = self._tiles, self._settings
        i = int(rng.integers(len(tiles)))
        a, b = tiles.points_a[i], tiles.points_b[i]
        if len(b) == 0 or rng.random() >= settings.revisit_share:
            still = rng.random() >= settings.rerun_share
            disturbance = drawn_disturbance(settings, rng) if still else None
            current = _stored_again(a, rng) if still else a
            return Observations(unchanged=(a, current), still=still, disturbance=disturbance)
        return Observations(unchanged=(a, b) if rng.random() < 0.5 else (b, a), revisit=True)

    def _revisited(self, observation: Observation, rng: np.random.Generator) -> Observations:
        """Pair the observation with the first visit's; the unchanged pair that matches is of both honest visits."""
        a, b = self._tiles.points_a[observation.tile], self._tiles.points_b[observation.tile]
        forth = rng.random() < 0.5
        both = (a, observation.points) if forth else (observation.points, a)
        if not observation.changed:
            return Observations(unchanged=both, revisit=True)
        return Observations(unchanged=(a, b) if forth else (b, a), changed=both, revisit=True)

    def _rebuilt_observations(self, rng: np.random.Generator) -> Observations:
        """Pair a rebuilt map with the map: a tile that a synthetic change was made in, and one that none was."""
        changed = self._rebuilt[int(rng.integers(len(self._rebuilt)))]
        pair = (self._tiles.points_a[changed.tile], changed.points)
        disturbance = drawn_disturbance(self._settings, rng)
        if not self._untouched:
            unchanged = (pair[0], pair[0])
        else:
            other = self._untouched[int(rng.integers(len(self._untouched)))]
            unchanged = (self._tiles.points_a[other.tile], other.points)
        return Observations(unchanged=unchanged, changed=pair, still=True, disturbance=disturbance)

    def _sampled(
        self, first: Points, second: Points, intensity: float, rng: np.random.Generator
    ) -> tuple[Points, Points]:
        reference, current = second_observation(first, second, self._settings.nuisance, intensity, rng)
        return self._patch(reference, rng), self._patch(current, rng)

    def _patch(self, points: Points, rng: np.random.Generator) -> Points:
        """Return the distinct points of a patch: what repeats would add, a max-pool does not see."""
        return patch(points, size=self._settings.patch_points, seed=int(rng.integers(2**31))).distinct


def _stored_again(points: Points, rng: np.random.Generator) -> Points:
    """Return (n, 3) a stored patch as it comes from the disk (paper, Section 3.5.3)."""
    return (points + rng.normal(scale=STORED_JITTER, size=points.shape)).astype(np.float32)


def drawn_disturbance(settings: PairSettings, rng: np.random.Generator) -> Disturbance | None:
    """Draw what a still pair suffers; most often nothing. Nothing is drawn where no pair is to suffer anything."""
    if settings.noisy_share == 0 or rng.random() >= settings.noisy_share:
        return None
    return some_disturbance(settings, rng)


def some_disturbance(settings: PairSettings, rng: np.random.Generator) -> Disturbance:
    """Draw noise, and in half of the cases lost points."""
    return Disturbance(
        noise=float(rng.uniform(0.0, settings.noise)),
        lost=float(rng.uniform(0.0, settings.thinning)) if rng.random() < 0.5 else 0.0,
    )


def disturbed(points: Points, disturbance: Disturbance | None, rng: np.random.Generator) -> Points:
    """Take points away from (n, 3), and move every other by noise; the very points for None. 64 points stay."""
    if disturbance is None:
        return points
    kept = rng.permutation(len(points))[: max(round((1 - disturbance.lost) * len(points)), 64)]
    noise = rng.normal(scale=disturbance.noise, size=(len(kept), 3))
    return (points[np.sort(kept)] + noise).astype(np.float32)


def changed(
    points: Points,
    settings: PairSettings,
    half: Half,
    rng: np.random.Generator,
    *,
    operation: Operation | None = None,
) -> Points:
    """Change a tile (n, 3) by the operation, or by any of them, each as likely, where None is given.

    A change of which too little shows is drawn again, a dozen times at most: a tile may have no place for one.
    """
    operation = operation or OPERATIONS[str(rng.choice(list(OPERATIONS)))]
    for _ in range(12):
        change = ChangeSize(
            magnitude=rng.uniform(*settings.magnitude), density=rng.uniform(*settings.density)
        )
        result = operation(points, change, half, rng)
        if settings.min_shown == 0 or shown(points, result, settings.shown_distance) >= settings.min_shown:
            break
    return result.points


def composition(
    count: int, shares: tuple[float, float, float], *, matched_pairs: bool = True
) -> list[tuple[int, ...]]:
    """Return `count` labels in exact shares, as groups of one tile each; what rounding leaves is unchanged."""
    changed_count, different = (round(count * share) for share in shares[1:])
    unchanged = count - changed_count - different
    both = min(unchanged, changed_count) if matched_pairs else 0
    return [
        *[(UNCHANGED, CHANGED)] * both,
        *[(UNCHANGED,)] * (unchanged - both),
        *[(CHANGED,)] * (changed_count - both),
        *[(DIFFERENT,)] * different,
    ]
