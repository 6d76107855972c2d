"""What is visited: buildings that no training set has, each mapped once and surveyed in several cases."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal, get_args

from pydantic import Field

from worker.benchmarks.documents import names_among
from worker.cloud.settings import StrictModel
from worker.pipeline.settings import PipelineSettings
from worker.simulation.scenes import BUILDINGS, BuildingKind, Scene
from worker.simulation.visits import DRIFT

Case = Literal["changed", "sparse", "unchanged"]
KINDS: tuple[BuildingKind, ...] = get_args(BuildingKind)
CASES: tuple[Case, ...] = get_args(Case)

TEST_SEED, VALIDATION_SEED = 700_000, 900_000  #: of the first building; training sets begin at 1000
RECIPE = 1  #: raised when the same settings begin to give other visits: kept ones are then made anew


class RevisitSettings(StrictModel):
    """How the visits are made; with the seeds, all that they depend on."""

    kinds: tuple[BuildingKind, ...] = Field(KINDS, min_length=1, description="of buildings, taken in turn")
    stops: dict[BuildingKind, int] = Field(
        {"room": 6, "office": 14, "corridor": 16, "loop": 24}, description="scans of the first visit"
    )
    edits: dict[BuildingKind, int] = Field(
        {"room": 3, "office": 6, "corridor": 6, "loop": 6},
        description="pieces added, removed, moved, in turn",
    )
    sparse_share: float = Field(1 / 3, gt=0, le=1, description="of the stops, in the case of that name")
    drift: tuple[float, float] = Field(DRIFT, description="a prior is off by at most (metres, degrees)")
    standing_s: float = Field(5.0, gt=0, description="seconds at each stop; about 20,000 points a second")
    pipeline: PipelineSettings = PipelineSettings()

    @property
    def fingerprint(self) -> str:
        """Equal for visits made alike."""
        text = f"{RECIPE} {self.model_dump_json(exclude={'kinds'})}"
        return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass(frozen=True, kw_only=True, slots=True)
class SitePlan:
    """A building and its first visit."""

    kind: BuildingKind
    seed: int

    @property
    def name(self) -> str:
        return f"{self.kind}-{self.seed}"

    def scene(self) -> Scene:
        """Build it as the first visit finds it."""
        return BUILDINGS[self.kind](self.seed)


@dataclass(frozen=True, kw_only=True, slots=True)
class VisitPlan:
    """A second visit."""

    site: SitePlan
    case: Case

    @property
    def name(self) -> str:
        return f"{self.site.name}-{self.case}"

    @property
    def seed(self) -> int:
        """Of poses, noise and edits; another one than the first visit's."""
        return 10 * self.site.seed + 1 + CASES.index(self.case)

    def stops(self, settings: RevisitSettings) -> int:
        """Return how many scans are taken."""
        count = settings.stops[self.site.kind]
        return max(1, round(count * settings.sparse_share)) if self.case == "sparse" else count

    def edits(self, settings: RevisitSettings) -> int:
        """Return how many things are added, removed and moved before it."""
        return 0 if self.case == "unchanged" else settings.edits[self.site.kind]


def plan_visits(count: int, settings: RevisitSettings, *, first_seed: int) -> tuple[VisitPlan, ...]:
    """Plan `count` visits, site after site: kinds of buildings in turn, in each one visit of every case."""
    plans = []
    for number in range(count):
        place, case = divmod(number, len(CASES))
        site = SitePlan(kind=settings.kinds[place % len(settings.kinds)], seed=first_seed + place)
        plans.append(VisitPlan(site=site, case=CASES[case]))
    return tuple(plans)


def kinds_named(words: str) -> tuple[BuildingKind, ...]:
    """Read a list with commas, in the order given. Raises ValueError for another name."""
    return names_among(words, KINDS, "building")
