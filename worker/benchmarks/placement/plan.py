"""What is tried: places that are mapped once, and on each map surveys of it, of places like it, and spoilt ones."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import count, product
from typing import Literal, get_args

from pydantic import Field

from worker.benchmarks.documents import names_among
from worker.cloud.settings import StrictModel
from worker.pipeline.registration.diagnosis import Reason
from worker.pipeline.settings import PipelineSettings
from worker.simulation.scenes import Scene, corridor, hotel_corridor, hotel_room, random_room, small_office
from worker.simulation.visits import DRIFT

SiteKind = Literal["room", "office", "corridor", "hotel-room", "hotel-corridor"]
Kind = Literal[
    "right",
    "other",
    "same-size",
    "twin",
    "hotel",
    "prior-off",
    "prior-turned",
    "mirrored",
    "scaled",
    "tilted",
    "wedge",
    "thin",
    "moving",
    "low-overlap",
    "mixed-1+1",
    "mixed-3+1",
]
Part = Literal["calibration", "validation", "figures"]
KINDS: tuple[Kind, ...] = get_args(Kind)
#: Surveys of another place that looks like the map's; each of them may only be refused.
IMPOSTORS: tuple[Kind, ...] = ("other", "same-size", "twin", "hotel")

#: The reasons that name what is odd about the scans of a kind, where the product names anything.
EXPECTED: Mapping[Kind, tuple[Reason, ...]] = {
    **dict.fromkeys(IMPOSTORS, ("other_place",)),
    "prior-off": ("wrong_prior",),
    "prior-turned": ("wrong_prior",),
    "mirrored": ("mirrored",),
    "scaled": ("wrong_scale",),
    "tilted": ("other_up_axis",),
    "moving": ("moved_while_scanning",),
    "low-overlap": ("too_little_overlap",),
    "mixed-1+1": ("other_place", "disagrees"),
    "mixed-3+1": ("other_place", "disagrees"),
}

#: Of the first place of each part. Other benchmarks use seeds up to 2,000,000 (training sets) and 1,900,000.
FIRST_SEED: Mapping[Part, int] = {"calibration": 2_100_000, "validation": 2_300_000, "figures": 2_500_000}
NEXT_TRIAL = 1000  #: between the seeds of two trials on one map; there are fewer maps than that
#: Raised when the same settings begin to give other maps, or other surveys: kept maps, or answers, are made anew then.
MAP_RECIPE, SURVEY_RECIPE = 1, 2

BUILDERS: Mapping[SiteKind, Callable[[int], Scene]] = {
    "room": random_room,
    "office": small_office,
    "corridor": corridor,
    "hotel-room": hotel_room,
    "hotel-corridor": hotel_corridor,
}
#: Kinds of places in turn; `half`: the map is of one end of it only.
SITES: tuple[tuple[SiteKind, bool], ...] = (
    ("room", False),
    ("corridor", False),
    ("hotel-room", False),
    ("room", False),
    ("office", False),
    ("corridor", True),
    ("room", False),
    ("hotel-corridor", False),
    ("room", False),
    ("office", True),
)


class PlacementSettings(StrictModel):
    """What the places and trials are; with the part, all that they depend on."""

    sites: int = Field(25, ge=1, lt=NEXT_TRIAL, description="places that are mapped")
    stops: dict[SiteKind, int] = Field(
        {"room": 5, "office": 8, "corridor": 12, "hotel-room": 4, "hotel-corridor": 12},
        description="scans of each map",
    )
    shares: tuple[float, ...] = Field(
        (0.0, 0.1, 0.25, 0.4), description="of the movable furniture that is edited before a right survey"
    )
    scales: tuple[float, ...] = Field((0.98, 0.99, 1.01, 1.02, 1.05), description="of scaled scans")
    metres_off: tuple[float, ...] = Field((1.0, 2.0, 5.0), description="of wrong priors")
    degrees_off: tuple[float, ...] = Field((90.0, 180.0, 0.0), description="of wrong priors; 0: any yaw")
    drift: tuple[float, float] = Field(DRIFT, description="a prior is off by at most (metres, degrees)")
    standing_s: float = Field(5.0, gt=0, description="seconds at each stop; about 20,000 points a second")
    pipeline: PipelineSettings = PipelineSettings()

    def without_reasons(self) -> PlacementSettings:
        """Return the same, but nobody asks why scans found no place: verdicts are as they were."""
        placement = self.pipeline.placement.with_values(diagnosed=0)
        return self.with_values(pipeline=self.pipeline.with_values(placement=placement))

    @property
    def fingerprint(self) -> str:
        """Equal for maps made alike."""
        chosen = ("sites", "shares", "scales", "metres_off", "degrees_off")
        surveys_alone = {"pipeline": {"placement"}}
        told = self.model_dump_json(exclude={**dict.fromkeys(chosen, True), **surveys_alone})
        return _hashed(f"{MAP_RECIPE} {told}")

    @property
    def survey_fingerprint(self) -> str:
        """Equal for surveys simulated alike and registered with the same settings."""
        return _hashed(f"{SURVEY_RECIPE} {self.pipeline.model_dump_json()}")


@dataclass(frozen=True, kw_only=True, slots=True)
class SitePlan:
    """A place and its map."""

    kind: SiteKind
    seed: int
    half: bool = False  #: the map is of the stops at one end of it only

    @property
    def name(self) -> str:
        return f"{self.kind}-{self.seed}{'-half' if self.half else ''}"

    @property
    def repeats(self) -> bool:
        """Whether the place looks the same again some metres on, so that a right scan may be ambiguous."""
        return self.kind == "hotel-corridor"

    def scene(self) -> Scene:
        """Build it as the map's visit finds it."""
        return BUILDERS[self.kind](self.seed)


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """A survey that is laid on a map."""

    site: SitePlan
    number: int  #: among those of its site
    kind: Kind
    prior: bool = False  #: whether the scans come with one
    scans: int = 1
    #: Of what the kind is about: share that is changed, factor of the scale, metres or degrees that the prior is off
    amount: float = 0.0

    @property
    def name(self) -> str:
        return f"{self.site.name}-{self.number:03d}-{self.kind}"

    @property
    def seed(self) -> int:
        """Of poses, noise and edits, and of the other place where it is of one."""
        return self.site.seed + NEXT_TRIAL * (1 + self.number)

    @property
    def other_number(self) -> int:
        """Which other room or floor of the same hotel a trial of kind `hotel` is of; odd rooms are mirrored."""
        return 1 + self.number

    @property
    def same_plan(self) -> bool:
        """Whether it is of a hotel room with the walls of the map's and the same furniture within some centimetres.

        Next to nothing tells it from the map's own room after its furniture was pushed about.
        """
        rooms = self.kind == "hotel" and self.site.kind == "hotel-room"
        return rooms and self.other_number % 2 == 0

    @property
    def row(self) -> str:
        """The row of the table that it counts in."""
        with_prior = ", prior" if self.prior else ""
        if self.kind == "right" and self.site.repeats:
            return f"right, hotel corridor{with_prior}"
        if self.kind == "hotel":
            room = "room, same plan" if self.same_plan else "room, mirrored"
            return f"hotel {'corridor' if self.site.repeats else room}{with_prior}"
        detail = {
            "right": f" {self.amount:.0%} changed",
            "prior-off": f" by {self.amount:g} m",
            "prior-turned": f" by {self.amount:g} degrees" if self.amount else " by any yaw",
            "scaled": f" by {self.amount:g}",
            "tilted": f" by {self.amount:g} degrees",
        }.get(self.kind, "")
        apart = not self.kind.startswith(("prior", "scaled"))
        return f"{self.kind}{detail}{with_prior if apart else ''}"

    @property
    def impostor(self) -> bool:
        """Whether every scan is of another place that looks like the map's."""
        return self.kind in IMPOSTORS


def plan_sites(settings: PlacementSettings, part: Part) -> tuple[SitePlan, ...]:
    """Plan the places of a part, their kinds in turn."""
    sites = (SITES[number % len(SITES)] for number in range(settings.sites))
    first = FIRST_SEED[part]
    return tuple(SitePlan(kind=kind, seed=first + row, half=half) for row, (kind, half) in enumerate(sites))


def trials(
    settings: PlacementSettings,
    part: Part,
    *,
    only: tuple[Kind, ...] = KINDS,
    most: int | None = None,
    all_impostors: bool = False,
) -> tuple[Trial, ...]:
    """Plan the trials of a part, place after place; of each row of the table at most so many, spread over the places.

    With `all_impostors` none of these is left out. A trial is the same one whatever is asked for beside it.
    """
    planned = [
        trial
        for site in plan_sites(settings, part)
        for trial in _trials_on(site, settings)
        if trial.kind in only
    ]
    if most is None:
        return tuple(planned)
    chosen: set[Trial] = set()
    for row in dict.fromkeys(trial.row for trial in planned):
        some = [trial for trial in planned if trial.row == row]
        if all_impostors and some[0].impostor:
            chosen.update(some)
            continue
        chosen.update(some[max(1, len(some) // most) * number] for number in range(min(most, len(some))))
    return tuple(trial for trial in planned if trial in chosen)


def kinds_named(words: str) -> tuple[Kind, ...]:
    """Read a list with commas, in the order given. Raises ValueError for another name."""
    return names_among(words, KINDS, "kind of trial")


def _hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _trials_on(site: SitePlan, settings: PlacementSettings) -> Iterator[Trial]:
    """Number what is tried on one map."""
    numbers = count()
    chosen = _low_overlap() if site.half else _all_kinds(site, settings)
    for kind, prior, scans, amount in chosen:
        yield Trial(
            site=site, number=next(numbers), kind=kind, prior=prior, scans=scans, amount=float(amount)
        )


Choice = tuple[Kind, bool, int, float]  #: kind, prior, scans, amount


def _low_overlap() -> Iterator[Choice]:
    yield from (("low-overlap", prior, 1, share) for prior in (False, True) for share in (0.0, 0.1, 0.25))


def _all_kinds(site: SitePlan, settings: PlacementSettings) -> Iterator[Choice]:
    both = (False, True)
    yield from (("right", prior, 1, share) for share, prior in product(settings.shares, both))
    yield from (("right", prior, scans, 0.25) for scans, prior in product((2, 4), both))
    for prior in both:
        yield from _impostors(site, prior)
    yield from (("prior-off", True, 1, metres) for metres in settings.metres_off)
    yield from (("prior-turned", True, 1, degrees) for degrees in settings.degrees_off)
    yield from (("mirrored", prior, 1, 0.0) for prior in both)
    yield from (
        ("scaled", (number + site.seed) % 2 == 1, 1, scale) for number, scale in enumerate(settings.scales)
    )
    yield from (("tilted", False, 1, degrees) for degrees in (90.0, 180.0))
    yield from (("wedge", False, 1, 120.0), ("thin", False, 1, 0.05))
    yield from (("moving", prior, 1, 0.0) for prior in both)
    yield from (("mixed-1+1", prior, 2, 0.0) for prior in both)
    yield from (("mixed-3+1", prior, 4, 0.0) for prior in both)


def _impostors(site: SitePlan, prior: bool) -> Iterator[Choice]:
    """Name four surveys of other places, and what else there is of places like this one; one of each has two scans."""
    sets: list[tuple[Kind, int]] = [("other", 4)]
    if site.kind == "room":
        sets.append(("same-size", 3))
    sets.append(("hotel", 4) if site.kind.startswith("hotel") else ("twin", 3))
    for kind, number in sets:
        yield from ((kind, prior, 2 if last == number - 1 else 1, 0.0) for last in range(number))
