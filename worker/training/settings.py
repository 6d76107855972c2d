"""What of a training can be set, and the learning rate that follows."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from worker.detectors.trainable import TrainableNetwork, network_class
from worker.training.pairs import PAPER_PAIRS, SAMPLE_POINTS, PairSettings


@dataclass(frozen=True, kw_only=True, slots=True)
class Schedule:
    """Cosine from `start` to `end` over the run (paper, Section 3.8).

    A run may be bounded by epochs, by wall-clock minutes, or by both; whichever is nearer to its end sets the
    place on the curve, so that the rate has come down when the time is up.
    """

    epochs: int
    minutes: float | None = None
    start: float = 1e-3
    end: float = 1e-5

    def done(self, epochs: float, seconds: float) -> float:
        """Return share 0..1 of the run behind us after so many epochs (fractions count) and seconds."""
        by_time = 0.0 if self.minutes is None else seconds / (60 * self.minutes)
        by_epochs = epochs / self.epochs if self.epochs else 1.0
        return min(max(by_epochs, by_time), 1.0)

    def rate(self, done: float) -> float:
        """Return the learning rate at that share."""
        return self.end + (self.start - self.end) * 0.5 * (1 + math.cos(math.pi * done))


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainSettings:
    """The paper's values, but for `minutes`."""

    detector: str = "spicd-net"  #: key in worker.detectors.registry.DETECTORS
    epochs: int = 1000
    minutes: float | None = None  #: wall clock of the whole run, resumed parts included; None: epochs alone
    patience: int = 100  #: epochs without a better checkpoint
    batch: int = 16  #: pairs
    train_pairs: int = 2000  #: an epoch
    validation_pairs: int = 500
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-5
    weight_decay: float = 1e-4
    held_out: float = 0.1  #: share of the tiles
    seed: int = 42
    #: What network is trained on, with a fresh optimiser: a checkpoint, or as said with `start`.
    start_from: str | None = None
    fresh_head: bool = False  #: ours: of that network the encoder alone is taken, and the head starts anew
    initialize_head: bool = True  #: ours: the head's first layers start as if their inputs were standardised
    head_epochs: int = 0  #: ours: after the last epoch the head goes on alone, on descriptors computed once
    head_batch: int = 64  #: pairs
    head_learning_rate: float = 1e-3  #: to begin with
    head_validation_pairs: int = 4000  #: they cost next to nothing
    device: str = "cpu"
    coarse_search: bool = (
        True  #: bfloat16 where max-pooling looks for its winners; a third less time on the CPU
    )
    pairs: PairSettings = field(default_factory=PairSettings)

    @property
    def network(self) -> TrainableNetwork[Any]:
        """What is trained. Raises KeyError for a detector that has no network."""
        return network_class(self.detector)(**detector_settings(asdict(self)))

    @property
    def schedule(self) -> Schedule:
        start, end = self.learning_rate, self.final_learning_rate
        return Schedule(epochs=self.epochs, minutes=self.minutes, start=start, end=end)


#: Sections 3.5 to 3.8 to the letter.
PAPER = TrainSettings(pairs=PAPER_PAIRS, initialize_head=False)


#: What checkpoints of release 0.1 call settings that have other names today.
_NAMES_OF_0_1 = {"settle_head": "initialize_head", "twins": "matched_pairs"}


def whole(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a checkpoint under their names of today; what they do not know yet has its default."""
    default = asdict(TrainSettings())
    pairs = {**default["pairs"], **_renamed(settings["pairs"])}
    return {**default, **_renamed(settings), "pairs": pairs}


def detector_settings(settings: dict[str, Any]) -> dict[str, Any]:
    """Return what of a checkpoint's settings the model's card says as its detector's own."""
    pairs = settings["pairs"]
    return {
        "patch_points": pairs["patch_points"],
        "chamfer_points": pairs.get("chamfer_points", SAMPLE_POINTS),
        "counts": pairs.get("counts", False),
        "seed": settings["seed"],
    }


def _renamed(settings: dict[str, Any]) -> dict[str, Any]:
    return {_NAMES_OF_0_1.get(name, name): value for name, value in settings.items()}
