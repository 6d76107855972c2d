"""What of a training can be set."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from worker.training.pairs import PAPER_PAIRS, PairSettings
from worker.training.schedule import Schedule


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainSettings:
    """The paper's values, but for `minutes`."""

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
    start_from: str | None = (
        None  #: what network is trained on, with a fresh optimiser: a checkpoint, or as said with `start`
    )
    fresh_head: bool = False  #: ours: of that network the encoder alone is taken, and the head starts anew
    settle_head: bool = True  #: ours: the head's first layers start as if their inputs were standardised
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
    def schedule(self) -> Schedule:
        return Schedule(
            epochs=self.epochs,
            minutes=self.minutes,
            start=self.learning_rate,
            end=self.final_learning_rate,
        )


#: Sections 3.5 to 3.8 to the letter.
PAPER = TrainSettings(pairs=PAPER_PAIRS, settle_head=False)


def whole(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings of a checkpoint; what they do not know yet has its default."""
    default = asdict(TrainSettings())
    return {**default, **settings, "pairs": {**default["pairs"], **settings["pairs"]}}
